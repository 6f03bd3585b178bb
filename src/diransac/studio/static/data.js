import {
  button,
  change,
  choice,
  get,
  h,
  isRate,
  notes,
  number,
  outcome,
  places,
  printed,
  put,
  run,
  say,
  told,
  unchanged,
} from "./page.js";
import { Plots } from "./plots.js";

const ROLES = [
  ["", "–"],
  ["logs", "use"],
  ["held-out", "hold out"],
];
const size = (n) =>
  n > 1e9
    ? `${(n / 1e9).toFixed(1)} GB`
    : n > 1e6
      ? `${(n / 1e6).toFixed(1)} MB`
      : n > 1e3
        ? `${Math.round(n / 1e3)} kB`
        : n
          ? `${n} B`
          : "folder";

// Logs of the folders, their signals over time, which column is which signal, and stretches that are left out.
export const data = (root, now) => {
  let listed = { logs: [] },
    file = null,
    facts = null,
    reading = "",
    chosen = new Set(),
    applied = 0;
  const [files, about, mapping, canvas, left] = places(5),
    modes = h(".row"),
    plotted = h("div", modes, canvas, left);
  put(
    root,
    h("h2", "Data"),
    h(
      "p.how",
      "Choose the logs to identify from, and hold out one to test the model with. Nothing leaves this machine, and no file is changed.",
    ),
    h(".columns", h("div", h("h3", "Logs"), files, mapping), h("div", about, plotted)),
  );
  const project = () => now().project;
  const plots = new Plots(canvas, {
    left: () => project()["leave-out"] || [],
    leave: (ends) =>
      change({ "leave-out": [...(project()["leave-out"] || []), ends].sort((a, b) => a[0] - b[0]) }),
  });
  const role = (name) =>
    ROLES.map(([key]) => key).find((key) => key && (project()[key] || []).includes(name)) || "";
  const setRole = (name, key) => {
    const lists = {};
    for (const x of ["logs", "held-out"]) {
      const rest = (project()[x] || []).filter((y) => y !== name);
      if (key === x) lists[x] = [...rest, name];
      else if (rest.length < (project()[x] || []).length) lists[x] = rest;
    }
    Object.assign(project(), lists); // for the next choice, which may come before the server's word on this one
    change(lists);
    if (key) open(name);
  };
  const drawFiles = () =>
    unchanged(files, listed, file, project().logs, project()["held-out"]) ||
    put(
      files,
      listed.logs.length
        ? h(
            "ul.list",
            listed.logs.map(({ name, size: bytes }) =>
              h(
                name === file ? "li.chosen" : "li",
                button(name, () => open(name), { title: name }),
                h("span.size", size(bytes)),
                choice(role(name), ROLES, (key) => setRole(name, key), { "aria-label": `role of ${name}` }),
              ),
            ),
          )
        : h(".empty", "No logs in these folders."),
      listed.more && h("p.how", "There are more files; start diransac studio with a smaller folder."),
    );

  const open = async (name) => {
    const key = JSON.stringify([
      name,
      ...["mapping", "columns", "rate", "repair", "map", "scale", "resample", "unmeasured"].map(
        (x) => project()[x],
      ),
    ]);
    if (key === reading) return;
    if (name !== file) {
      chosen = new Set();
      put(about, h("p.how", `Reading ${name} …`));
      plotted.hidden = true;
    }
    [reading, file] = [key, name];
    drawFiles();
    try {
      const found = await get("log", { name });
      if (key !== reading) return;
      facts = found;
      const names = facts.signals.map((x) => x.name);
      chosen = new Set([...chosen].filter((x) => names.includes(x)));
      // Stamps of messages are no signals, and come first.
      const telling = names.filter((x) => !/\.stamp\b/.test(x));
      if (!chosen.size) (telling.length ? telling : names).slice(0, 6).forEach((x) => chosen.add(x));
      plotted.hidden = false;
      drawLog();
    } catch (error) {
      facts = null;
      put(about, h("h3", name), h("p.error", error.message));
      plotted.hidden = true;
      drawMapping();
    }
  };
  const chip = ({ name, unit, missing }) => {
    const lacking = missing ? `${missing} samples are missing; ` : "",
      text = [name, unit && h("small.unit", ` ${unit}`), missing > 0 && h("span.bad", `${missing} missing`)];
    const toggle = () => {
      if (!chosen.delete(name)) chosen.add(name);
      drawLog();
    };
    return button(text, toggle, {
      className: "chip",
      draggable: true,
      "aria-pressed": chosen.has(name),
      title: `${lacking}drag it onto a signal of the model`,
      ondragstart: (event) => event.dataTransfer.setData("text/plain", name),
    });
  };
  const drawLog = () => {
    put(
      about,
      h("h3", file),
      h(
        "p.how",
        `${facts.rows.toLocaleString("en")} rows at ${number(1 / facts.dt, 6)} Hz, ${number(facts.start, 6)} to ${number(facts.start + facts.dt * (facts.rows - 1), 6)} s`,
      ),
      facts.raw && h("p.how", `These are the fields of the file: ${facts.raw}`),
      notes(facts.notes.slice(0, 8)),
      h(".chips", { role: "group", "aria-label": "Signals that are shown" }, facts.signals.map(chip)),
    );
    drawModes();
    plots.show(
      file,
      facts,
      facts.signals.map((x) => x.name).filter((x) => chosen.has(x)),
    );
    drawMapping();
  };
  const drawModes = () => {
    if (unchanged(modes, plots.mode, project()["leave-out"])) return;
    const mode = (key, text) => {
      const choose = () => {
        plots.mode = key;
        canvas.classList.toggle("leaving", key === "leave");
        drawModes();
      };
      return button(text, choose, { "aria-pressed": plots.mode === key });
    };
    put(
      modes,
      mode("zoom", "Drag to zoom"),
      mode("leave", "Drag to leave out"),
      button("Whole log", () => plots.zoom(...plots.home)),
      h("span.how", "Double-click or 0: all; arrows, + and −; Shift and wheel."),
    );
    const ranges = project()["leave-out"] || [];
    put(
      left,
      ranges.length > 0 &&
        h(
          ".row",
          h("span.how", "Left out of every log:"),
          ranges.map((ends, k) =>
            button(
              `${number(ends[0], 6)} … ${number(ends[1], 6)} s  ✕`,
              () => change({ "leave-out": ranges.filter((_, j) => j !== k) }),
              { className: "chip", title: "take it back" },
            ),
          ),
        ),
    );
  };

  // ---- which column is which signal of the model
  let model = null;
  const drawMapping = () => {
    const {
      project: { mapping: file_, map = {}, model: name },
      jobs,
    } = now();
    if (unchanged(mapping, now().project, model, facts, jobs.map?.number, jobs.map?.status)) return;
    if (!name || !model || !facts) {
      const what = name
        ? facts && "Read the model in Model first."
        : "Choose a model to see which of its signals the log has.";
      put(mapping, h("h3", "Signals of the model"), h("p.how", what));
      return;
    }
    const columns = facts.fields,
      has = new Set(facts.signals.map((x) => x.name));
    const assign = (signal, column) => {
      const rest = Object.fromEntries(Object.entries(map).filter(([x]) => x !== signal));
      change({ map: column && column !== signal ? { ...rest, [signal]: column } : rest });
    };
    const row = ([signal, unit]) => {
      const from =
        map[signal] || (!facts.raw && has.has(signal) ? signal : columns.includes(signal) ? signal : "");
      const lacking = isRate(signal) ? "derived" : "missing";
      const drop = {
        ondragover: (event) => {
          event.preventDefault();
          event.currentTarget.classList.add("over");
        },
        ondragleave: (event) => event.currentTarget.classList.remove("over"),
        ondrop: (event) => {
          event.preventDefault();
          event.currentTarget.classList.remove("over");
          assign(signal, event.dataTransfer.getData("text/plain"));
        },
      };
      const options = [["", lacking], ...(from && !columns.includes(from) ? [from] : []), ...columns];
      return h(
        "tr",
        drop,
        h("th", { scope: "row" }, signal, h("span.unit", ` ${unit}`)),
        h(
          "td",
          choice(from, options, (column) => assign(signal, column), {
            "aria-label": `column of ${signal}`,
            className: from || lacking === "derived" ? "" : "is-bad",
            disabled: Boolean(file_),
          }),
        ),
      );
    };
    put(
      mapping,
      h("h3", `Signals of ${name}`),
      h(
        ".row",
        button("Suggest", () => {
          applied = -1;
          run("map", { log: file });
        }),
        file_ && h("span.how", `by the mapping ${file_}`),
        (file_ || Object.keys(map).length > 0) && button("Clear", () => change({ mapping: null, map: {} })),
      ),
      outcome(jobs.map, "Looking for columns"),
      h(".scroll.tall", h("table", h("tbody", model.map(row)))),
    );
  };
  const suggested = async (state) => {
    const job = state.jobs.map;
    if (!job || job.status !== "done" || applied !== -1) return;
    applied = job.number;
    const found = await printed(state, "map");
    const map = Object.fromEntries(
      Object.entries(found.mapped).filter(([signal, column]) => signal !== column),
    );
    const missing = Object.keys(found.missing);
    if (missing.length) say(`Not found: ${missing.join(", ")}. Choose their columns by hand.`);
    change(found.mapping ? { mapping: found.mapping, map: {} } : { map });
  };
  told(get("files")).then((found) => {
    listed = found || listed;
    drawFiles();
    if (!file && listed.logs.length) open(listed.logs[0].name);
  });
  return async (state) => {
    if (!file && (state.project.logs || []).length) open(state.project.logs[0]);
    drawFiles();
    suggested(state);
    const equations = await printed(state, "model");
    model = equations && [...Object.entries(equations.signals), ...Object.entries(equations.inputs)];
    if (file) open(file);
    if (facts) {
      drawModes();
      drawMapping();
      plots.plots.forEach(({ plot }) => plot.redraw(false));
    }
  };
};
