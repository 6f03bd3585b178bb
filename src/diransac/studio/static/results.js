import {
  button,
  change,
  choice,
  get,
  h,
  link,
  noResult,
  number,
  numberField,
  outcome,
  places,
  printed,
  put,
  run,
  table,
  told,
  unchanged,
} from "./page.js";
import { View } from "./view.js";

const LEVELS = { usable: "good", "usable with care": "care", "do not rely on this": "bad" };
const verdict = (found, title) =>
  h(
    `.card.${LEVELS[found.verdict]}`,
    h("h3", title ? `${title}: ${found.verdict}` : found.verdict),
    h(
      "ul",
      found.findings
        .filter((x) => Object.values(LEVELS).includes(x.level))
        .slice(0, 7)
        .map((x) => h(`li.${x.level}`, x.text)),
    ),
  );
const whisker = (value, narrow, wide) => {
  const [a, b] = wide || narrow,
    [c, d] = narrow;
  if (![a, b, c, d, value].every(Number.isFinite)) return "";
  const low = Math.min(a, c, value),
    high = Math.max(b, d, value),
    pad = 0.06 * (high - low || 1),
    at = (x) => `${(100 * (x - low + pad)) / (high - low + 2 * pad || 1)}%`,
    from = (x) => `${100 - parseFloat(at(x))}%`;
  const part = (name, left, right) => {
    const i = h(`i.${name}`);
    i.style.left = at(left);
    if (right !== undefined) i.style.right = from(right);
    return i;
  };
  return h(
    ".whisker",
    { title: "dot: estimate; line: if the model is complete; bar: if it may lack a term" },
    part("wide", a, b),
    part("narrow", c, d),
    part("at", value),
  );
};
// Verdict, intervals, competition, held-out prediction, and terms that the model seems to lack.
export const results = (root, now) => {
  let chosen = "",
    shown = "",
    page = "",
    view = null,
    log = "",
    predicted = 0,
    horizon = null;
  const [pick, about, held, pages, frame, motion] = places(6);
  put(root, h("h2", "Results"), pick, about, held, motion, pages, frame);
  const drawResult = async (state) => {
    const key = `${state.results.join()} ${state.jobs.solve?.number} ${state.stale}`;
    if (!state.results.length) {
      shown = "";
      put(about, noResult());
      return;
    }
    if (!state.results.includes(chosen)) [chosen] = state.results;
    const pickLimb = (name) => {
      chosen = name;
      shown = "";
      drawResult(now());
      drawPages(now(), page);
    };
    const solveAgain = () => {
      run("solve");
      location.hash = "solve";
    };
    const addTerms = async (names) => {
      const terms = [...new Set([...(now().project["add-terms"] || []), ...names])];
      if ((await change({ "add-terms": terms, "with-suggestions": null })) && (await run("solve")))
        location.hash = "solve";
    };
    put(
      pick,
      state.results.length > 1 &&
        h(
          ".row",
          h(
            "label",
            "Limb",
            choice(
              chosen,
              state.results.map((x) => [x, x.replace(/^.*model-|\.json$/g, "")]),
              pickLimb,
            ),
          ),
        ),
    );
    if (key + chosen === shown) return;
    shown = key + chosen;
    const found = await get("result", { name: chosen }),
      { parameters, fixed, units } = found;
    const rows = Object.keys(parameters).map((name) => [
      name,
      number(parameters[name], 5),
      ...(fixed.includes(name)
        ? ["fixed", "fixed"]
        : [found.intervals_text[name], found.structural_text[name] || "not tested"]),
      units[name],
      fixed.includes(name)
        ? ""
        : whisker(parameters[name], found.intervals_95[name], found.structural_intervals_95?.[name]),
    ]);
    put(
      about,
      state.stale &&
        h(
          "p.error",
          "The project has changed since this result was made. ",
          button("Solve again", solveAgain),
        ),
      verdict(found),
      table(
        [
          "parameter",
          "estimate",
          "95 % interval, if the model is complete",
          "if it may lack a term",
          "unit",
          "",
        ],
        rows,
      ),
      found.suggestions.length > 0 &&
        h(
          "div",
          h("h3", "Terms that the model seems to lack"),
          table(
            ["term", "coefficient", "unit", "explains", "change of the model", ""],
            found.suggestions.map((x, k) => [
              x.name || x.kind,
              `${number(x.value)} ± ${number(x.standard_error, 2)}`,
              x.unit,
              `${Math.round(100 * x.explained)} %`,
              h("code", found.changes[k]),
              button("Add and solve again", () => addTerms([x.parameter])),
            ]),
          ),
          found.suggestions.length > 1 &&
            h(
              ".row",
              button("Add all and solve again", () => addTerms(found.suggestions.map((x) => x.parameter))),
            ),
        ),
      found.competition &&
        h(
          "details",
          h("summary", "Competition: estimates compared by held-out prediction"),
          table(found.competition.header, found.competition.rows),
        ),
    );
  };
  const drawHeld = async (state) => {
    const heldOut = state.project["held-out"] || [],
      job = state.jobs.validate,
      setHorizon = (text) => (horizon = Number(text) || null),
      made = await printed(state, "validate");
    if (unchanged(held, heldOut, made, state.results, job?.status, job?.error, chosen)) return;
    put(
      held,
      h("h3", "Prediction over held-out logs"),
      heldOut.length
        ? h(
            ".row",
            button(`Predict ${heldOut.join(", ")}`, () => run("validate", { horizon, result: chosen }), {
              disabled: !state.results.length || job?.status === "running",
            }),
            h(
              "label",
              "restart every",
              numberField(horizon, setHorizon, { min: 0, placeholder: "auto" }),
              "s",
            ),
          )
        : h("p.how", "No log is held out. ", h("a", { href: "#data" }, "Set one aside in Data.")),
      outcome(job, "Predicting"),
      made && verdict(made, "Held out"),
    );
  };
  const drawPages = (state, wanted) => {
    const all = [
      ...(state.results.length ? [["solve", "Report"]] : []),
      ...(state.jobs.validate?.status === "done" ? [["validate", "Held-out report"]] : []),
    ];
    put(
      pages,
      all.length > 0 &&
        h(
          ".tabs",
          all.map(([kind, text]) =>
            button(text, () => drawPages(now(), kind), { "aria-pressed": page.startsWith(kind) }),
          ),
        ),
    );
    const kind = wanted || (page && page.split(" ")[0]) || (all[0] || [""])[0],
      number_ = state.jobs[kind]?.number ?? 0;
    if (!kind || page === `${kind} ${number_} ${chosen}`) return;
    page = `${kind} ${number_} ${chosen}`;
    put(
      frame,
      h("iframe", {
        title: "Report",
        loading: "lazy",
        sandbox: "allow-scripts",
        src: link("report", { kind, result: chosen, n: number_ }),
      }),
    );
    drawPages(state);
  };
  const drawMotion = (state) => {
    const logs = [...(state.project["held-out"] || []), ...(state.project.logs || [])],
      job = state.jobs.predict;
    if (!logs.includes(log)) [log] = logs;
    if (!state.results.length || !log || state.code || state.project.model?.endsWith(".json")) {
      put(motion);
      return;
    }
    if (
      job?.status === "done"
        ? unchanged(motion, logs, log, job.number, predicted !== -1)
        : unchanged(motion, logs, log, job?.status, job?.error)
    )
      return;
    const predict = () => {
      predicted = -1;
      run("predict", { log, horizon: horizon || 1, result: chosen });
    };
    const place = motion.querySelector(".place") || h(".place");
    put(
      motion,
      h("h3", "Measured beside predicted motion"),
      h(
        ".row",
        h(
          "label",
          "Log",
          choice(log, logs, (name) => (log = name)),
        ),
        button("Show the motion", predict, { disabled: job?.status === "running" }),
      ),
      outcome(job, "Predicting"),
      place,
    );
    if (job?.status !== "done" || predicted !== -1) return;
    predicted = job.number;
    view = View.show(place, { name: log, predicted: 1 }, view);
  };
  return (state) => {
    told(drawResult(state).then(() => drawPages(state)));
    drawHeld(state);
    drawMotion(state);
  };
};
