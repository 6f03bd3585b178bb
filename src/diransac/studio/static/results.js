import {
  change,
  choice,
  get,
  h,
  link,
  number,
  outcome,
  printed,
  put,
  run,
  say,
  table,
  unchanged,
} from "./page.js";
import { View } from "./view.js";

const LEVELS = { usable: "good", "usable with care": "care", "do not rely on this": "bad" };
const SHOWN = ["bad", "care", "good"];
export const verdict = (found, title) =>
  h(
    `.card.${LEVELS[found.verdict]}`,
    {},
    h("h3", {}, title ? `${title}: ${found.verdict}` : found.verdict),
    h(
      "ul",
      {},
      found.findings
        .filter((x) => SHOWN.includes(x.level))
        .slice(0, 7)
        .map((x) => h(`li.${x.level}`, {}, x.text)),
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
  const pick = h("div"),
    about = h("div"),
    held = h("div"),
    pages = h("div"),
    frame = h("div"),
    motion = h("div");
  put(root, h("h2", {}, "Results"), pick, about, held, motion, pages, frame);
  const drawResult = async (state) => {
    const key = `${state.results.join()} ${state.jobs.solve?.number} ${state.stale}`;
    if (!state.results.length) {
      shown = "";
      put(about, h(".empty", {}, "No result yet. ", h("a.button", { href: "#solve" }, "Solve")));
      return;
    }
    if (!state.results.includes(chosen)) [chosen] = state.results;
    put(
      pick,
      state.results.length > 1 &&
        h(
          ".row",
          {},
          h(
            "label",
            {},
            "Limb",
            choice(
              chosen,
              state.results.map((x) => [x, x.replace(/^.*model-|\.json$/g, "")]),
              {
                onchange: (event) => {
                  chosen = event.target.value;
                  shown = "";
                  drawResult(now());
                  drawPages(now(), page);
                },
              },
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
          {},
          "The project has changed since this result was made. ",
          h(
            "button",
            {
              type: "button",
              onclick: () => {
                run("solve");
                location.hash = "solve";
              },
            },
            "Solve again",
          ),
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
          {},
          h("h3", {}, "Terms that the model seems to lack"),
          table(
            ["term", "coefficient", "unit", "explains", "change of the model"],
            found.suggestions.map((x, k) => [
              x.name || x.kind,
              `${number(x.value)} ± ${number(x.standard_error, 2)}`,
              x.unit,
              `${Math.round(100 * x.explained)} %`,
              h("code", {}, found.changes[k]),
            ]),
          ),
          h(
            ".row",
            {},
            h(
              "button",
              {
                type: "button",
                onclick: async () => {
                  if ((await change({ "with-suggestions": true })) && (await run("solve")))
                    location.hash = "solve";
                },
              },
              "Add these terms and solve again",
            ),
          ),
        ),
      found.competition &&
        h(
          "details",
          {},
          h("summary", {}, "Competition: estimates compared by held-out prediction"),
          table(found.competition.header, found.competition.rows),
        ),
    );
  };
  const drawHeld = async (state) => {
    const heldOut = state.project["held-out"] || [],
      made = await printed(state, "validate");
    if (
      unchanged(
        held,
        heldOut,
        made,
        state.results,
        state.jobs.validate?.status,
        state.jobs.validate?.error,
        chosen,
      )
    )
      return;
    put(
      held,
      h("h3", {}, "Prediction over held-out logs"),
      heldOut.length
        ? h(
            ".row",
            {},
            h(
              "button",
              {
                type: "button",
                disabled: !state.results.length || state.jobs.validate?.status === "running",
                onclick: () => run("validate", { horizon, result: chosen }),
              },
              `Predict ${heldOut.join(", ")}`,
            ),
            h(
              "label",
              {},
              "restart every",
              h("input", {
                type: "number",
                step: "any",
                min: 0,
                value: horizon ?? "",
                placeholder: "auto",
                onchange: (event) => {
                  horizon = Number(event.target.value) || null;
                },
              }),
              "s",
            ),
          )
        : h("p.how", {}, "No log is held out. ", h("a", { href: "#data" }, "Set one aside in Data.")),
      outcome(state.jobs.validate, "Predicting"),
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
          {},
          all.map(([kind, text]) =>
            h(
              "button",
              {
                type: "button",
                "aria-pressed": String(page.startsWith(kind)),
                onclick: () => drawPages(now(), kind),
              },
              text,
            ),
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
  const drawMotion = async (state) => {
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
    const place = motion.querySelector(".place") || h(".place");
    put(
      motion,
      h("h3", {}, "Measured beside predicted motion"),
      h(
        ".row",
        {},
        h(
          "label",
          {},
          "Log",
          choice(
            log,
            logs.map((x) => [x, x]),
            {
              onchange: (event) => {
                log = event.target.value;
              },
            },
          ),
        ),
        h(
          "button",
          {
            type: "button",
            disabled: job?.status === "running",
            onclick: () => {
              predicted = -1;
              run("predict", { log, horizon: horizon || 1, result: chosen });
            },
          },
          "Show the motion",
        ),
      ),
      outcome(job, "Predicting"),
      place,
    );
    if (job?.status !== "done" || predicted !== -1) return;
    predicted = job.number;
    view?.stop();
    view = new View();
    try {
      await view.load({ name: log, predicted: 1 });
      put(place, view.element);
      view.start();
    } catch (error) {
      put(place, h("p.how", {}, `No view: ${error.message}`));
    }
  };
  return (state) => {
    drawResult(state)
      .then(() => {
        drawPages(state);
      })
      .catch((error) => say(error.message));
    drawHeld(state);
    drawMotion(state);
  };
};
