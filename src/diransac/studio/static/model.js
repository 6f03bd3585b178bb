import { change, choice, get, h, number, outcome, post, printed, put, run, say, unchanged } from "./page.js";
import { View } from "./view.js";

const UNKNOWN = ["armature", "damping", "friction", "spring", "stribeck", "offset"];
const bounds = (x) =>
  [
    x.positive ? "0 <" : Number.isFinite(x.lower) && x.lower !== null ? `${number(x.lower)} ≤` : "",
    "value",
    Number.isFinite(x.upper) && x.upper !== null ? `≤ ${number(x.upper)}` : "",
  ]
    .join(" ")
    .replace(/^ ?value ?$/, "any");

// A built-in model, a description of a robot, a result, or the user's own code, which is named before it runs.
export const model = (root, now) => {
  let listed = { models: [], builtin: [] },
    view = null,
    viewed = "",
    read = "",
    source = null;
  const list = h("div"),
    about = h("div"),
    code = h("div"),
    place = h("div"),
    equations = h("div");
  put(
    root,
    h("h2", {}, "Model"),
    h("p.how", {}, "Choose the equations whose parameters are to be identified."),
    h(".columns", {}, h("div", {}, list), h("div", {}, about, code, place, equations)),
  );
  const pick = (name) =>
    change({
      model: name,
      fix: {},
      unknown: null,
      bodies: null,
      base: null,
      joints: null,
      control: {},
      motor: {},
    });
  const entries = (title, names) =>
    names.length > 0 && [
      h("h3", {}, title),
      h(
        "ul.list",
        {},
        names.map((name) =>
          h(
            name === now().project.model ? "li.chosen" : "li",
            {},
            h(
              "button",
              {
                type: "button",
                "aria-pressed": String(name === now().project.model),
                onclick: () => pick(name),
              },
              name,
            ),
          ),
        ),
      ),
    ];
  const drawList = () => {
    if (unchanged(list, listed, now().project.model)) return;
    const of = (...endings) =>
      listed.models.map((x) => x.name).filter((x) => endings.some((y) => x.toLowerCase().endsWith(y)));
    put(
      list,
      entries("Built in", listed.builtin),
      entries("Descriptions of robots", of(".urdf", ".xml", ".mjcf")),
      entries("Your own code", of(".py")),
      entries(
        "Results",
        of(".json").filter((x) => !x.endsWith("-metadata.json")),
      ),
    );
  };
  const drawRobot = (state) => {
    if (unchanged(about, state.project, state.robot)) return;
    const { project } = state,
      chosen = project.unknown || ["armature", "damping", "friction"];
    const toggle = (x) =>
      change({ unknown: chosen.includes(x) ? chosen.filter((y) => y !== x) : [...chosen, x] });
    put(
      about,
      h("h3", {}, project.model),
      state.robot &&
        h(
          "div",
          {},
          h(
            ".row",
            {},
            "Unknown in every joint:",
            UNKNOWN.map((x) =>
              h(
                "button.chip",
                { type: "button", "aria-pressed": String(chosen.includes(x)), onclick: () => toggle(x) },
                x,
              ),
            ),
          ),
          h(
            ".row",
            {},
            h(
              "label",
              {},
              "Inertial parameters of bodies",
              choice(
                (project.bodies || [""])[0] === "all" ? "all" : "",
                [
                  ["", "known"],
                  ["all", "all unknown"],
                ],
                { onchange: (event) => change({ bodies: event.target.value ? ["all"] : null }) },
              ),
            ),
            h(
              "label",
              {},
              "Base",
              choice(
                project.base || "",
                [
                  ["", "fixed"],
                  ["held", "floating, held"],
                  ["measured", "floating, measured"],
                ],
                { onchange: (event) => change({ base: event.target.value || null }) },
              ),
            ),
          ),
        ),
    );
  };
  const drawCode = async (state) => {
    if (!state.code) {
      put(code);
      source = null;
      return;
    }
    if (!source || source.sha256 !== state.code.sha256 || source.name !== state.code.name)
      source = await get("code").catch((error) => say(error.message));
    if (!source) return;
    if (unchanged(code, state.code, source)) return;
    put(
      code,
      h("pre", { tabIndex: 0 }, h("code", {}, source.text)),
      !state.code.confirmed &&
        h(
          ".card.care",
          {},
          h("h3", {}, `Run ${state.code.name}?`),
          h("p", {}, "It is a program and runs with your rights. It has not been run yet."),
          h(
            "button.main",
            {
              type: "button",
              onclick: async () => {
                if (await post("confirm", { name: source.name, sha256: source.sha256 })) run("model");
              },
            },
            `Run ${state.code.name}`,
          ),
        ),
    );
  };
  const drawEquations = (found, state) => {
    const fixed = state.project.fix || {};
    const fix = (name, text) => {
      const rest = Object.fromEntries(Object.entries(fixed).filter(([x]) => x !== name)),
        value = Number(text);
      if (text !== "" && !Number.isFinite(value)) say(`${text} is no number`);
      else change({ fix: text === "" ? rest : { ...rest, [name]: value } });
    };
    put(
      equations,
      h("h3", {}, "Parameters"),
      table_(found, fixed, fix),
      h("h3", {}, "Equations"),
      h("pre", { tabIndex: 0 }, h("code", {}, found.equations.join("\n"))),
      h("h3", {}, "Signals"),
      h(
        "p",
        {},
        Object.entries(found.signals)
          .map(([x, unit]) => `${x} [${unit}]`)
          .join(", "),
      ),
      h(
        "p",
        {},
        "Inputs: ",
        Object.entries(found.inputs)
          .map(([x, unit]) => `${x} [${unit}]`)
          .join(", "),
      ),
    );
  };
  const table_ = (found, fixed, fix) =>
    h(
      ".scroll",
      {},
      h(
        "table",
        {},
        h(
          "thead",
          {},
          h(
            "tr",
            {},
            ["parameter", "unit", "bounds", "nominal", "known value"].map((x) =>
              h("th", { scope: "col" }, x),
            ),
          ),
        ),
        h(
          "tbody",
          {},
          Object.entries(found.parameters).map(([name, x]) =>
            h(
              "tr",
              {},
              h("th", { scope: "row" }, name),
              h("td", {}, x.unit),
              h("td", {}, bounds(x)),
              h("td.number", {}, number(x.value)),
              h(
                "td",
                {},
                h("input", {
                  type: "number",
                  step: "any",
                  value: fixed[name] ?? "",
                  placeholder: "identify",
                  "aria-label": `known value of ${name}`,
                  onchange: (event) => fix(name, event.target.value),
                }),
              ),
            ),
          ),
        ),
      ),
    );
  const drawView = async (state) => {
    const key = JSON.stringify([
      state.project.model,
      state.project.logs,
      state.project.map,
      state.project.mapping,
    ]);
    if (key === viewed || state.code || !state.project.model || state.project.model.endsWith(".json")) {
      if (state.code) put(place);
      return;
    }
    viewed = key;
    view?.stop();
    view = new View();
    try {
      await view.load({ ...(state.project.logs?.length ? { name: state.project.logs[0] } : {}) });
      put(place, view.element);
      view.start();
    } catch (error) {
      put(place, h("p.how", {}, `No view: ${error.message}`));
    }
  };
  get("files")
    .then((found) => {
      listed = found;
      drawList();
    })
    .catch((error) => say(error.message));
  return async (state) => {
    drawList();
    if (!state.project.model) {
      unchanged(about);
      put(about, h(".empty", {}, "No model yet."));
      put(code);
      put(place);
      put(equations);
      return;
    }
    drawRobot(state);
    drawCode(state);
    drawView(state);
    const wanted = state.commands.model.shell,
      job = state.jobs.model;
    if (!job || job.command !== wanted || job.status !== "done") {
      read = "";
      put(equations, job && job.command === wanted && outcome(job, "Reading the model"));
      return;
    }
    const key = JSON.stringify([job.number, state.project.fix]);
    if (key !== read) {
      read = key;
      drawEquations(await printed(state, "model"), state);
    }
  };
};
