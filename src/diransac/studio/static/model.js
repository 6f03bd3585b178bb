import {
  button,
  change,
  choice,
  get,
  h,
  number,
  numberField,
  outcome,
  places,
  post,
  printed,
  put,
  run,
  say,
  table,
  told,
  unchanged,
} from "./page.js";
import { View } from "./view.js";

const BODIES = [
  ["", "known"],
  ["all", "all unknown"],
];
const BASES = [
  ["", "fixed"],
  ["held", "floating, held"],
  ["measured", "floating, measured"],
];
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
  const [list, about, code, place, equations] = places(5);
  put(
    root,
    h("h2", "Model"),
    h("p.how", "Choose the equations whose parameters are to be identified."),
    h(".columns", h("div", list), h("div", about, code, place, equations)),
  );
  const others = { unknown: null, bodies: null, base: null, inertia: null, joints: null, passive: null, control: {}, motor: {} };
  const pick = (name) => change({ model: name, fix: {}, ...others });
  const entries = (title, names) =>
    names.length > 0 && [
      h("h3", title),
      h(
        "ul.list",
        names.map((name) => {
          const isChosen = name === now().project.model;
          return h(
            isChosen ? "li.chosen" : "li",
            button(name, () => pick(name), { "aria-pressed": isChosen }),
          );
        }),
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
      h("h3", project.model),
      state.robot &&
        h(
          "div",
          h(
            ".row",
            "Unknown in every joint:",
            UNKNOWN.map((x) =>
              button(x, () => toggle(x), { className: "chip", "aria-pressed": chosen.includes(x) }),
            ),
          ),
          h(
            ".row",
            h(
              "label",
              "Inertial parameters of bodies",
              choice((project.bodies || [""])[0] === "all" ? "all" : "", BODIES, (key) =>
                change({ bodies: key ? [key] : null }),
              ),
            ),
            h(
              "label",
              "Base",
              choice(project.base || "", BASES, (key) => change({ base: key || null })),
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
      source = await told(get("code"));
    if (!source) return;
    if (unchanged(code, state.code, source)) return;
    const confirm = async () => {
      if (await post("confirm", { name: source.name, sha256: source.sha256 })) run("model");
    };
    put(
      code,
      h("pre", { tabIndex: 0 }, h("code", source.text)),
      !state.code.confirmed &&
        h(
          ".card.care",
          h("h3", `Run ${state.code.name}?`),
          h("p", "It is a program and runs with your rights. It has not been run yet."),
          button(`Run ${state.code.name}`, confirm, { className: "main" }),
        ),
    );
  };
  const drawEquations = (found, fixed) => {
    const fix = (name, text) => {
      const rest = Object.fromEntries(Object.entries(fixed).filter(([x]) => x !== name)),
        value = Number(text);
      if (text !== "" && !Number.isFinite(value)) say(`${text} is no number`);
      else change({ fix: text === "" ? rest : { ...rest, [name]: value } });
    };
    const field = (name) =>
      numberField(fixed[name], (text) => fix(name, text), {
        placeholder: "identify",
        "aria-label": `known value of ${name}`,
      });
    const withUnits = (units) =>
      Object.entries(units)
        .map(([x, unit]) => `${x} [${unit}]`)
        .join(", ");
    put(
      equations,
      h("h3", "Parameters"),
      table(
        ["parameter", "unit", "bounds", "nominal", "known value"],
        Object.entries(found.parameters).map(([name, x]) => [
          name,
          x.unit,
          bounds(x),
          number(x.value),
          field(name),
        ]),
      ),
      h("h3", "Equations"),
      h("pre", { tabIndex: 0 }, h("code", found.equations.join("\n"))),
      h("h3", "Signals"),
      h("p", withUnits(found.signals)),
      h("p", "Inputs: ", withUnits(found.inputs)),
    );
  };
  const drawView = (state) => {
    const { model: name, logs, map, mapping } = state.project,
      key = JSON.stringify([name, logs, map, mapping]);
    if (state.code) {
      view?.stop();
      viewed = "";
      put(place);
    }
    if (key === viewed || state.code || name.endsWith(".json")) return;
    viewed = key;
    view = View.show(place, logs?.length ? { name: logs[0] } : {}, view);
  };
  told(get("files")).then((found) => {
    listed = found || listed;
    drawList();
  });
  return async (state) => {
    drawList();
    if (!state.project.model) {
      unchanged(about);
      put(about, h(".empty", "No model yet."));
      [code, place, equations].forEach((x) => put(x));
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
      drawEquations(await printed(state, "model"), state.project.fix || {});
    }
  };
};
