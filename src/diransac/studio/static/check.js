import {
  button,
  download,
  h,
  isRate,
  notes,
  number,
  numberField,
  places,
  outcome,
  printed,
  put,
  run,
  table,
  toStage,
  unchanged,
} from "./page.js";

const WORDS = {
  well: ["well determined", "is-good"],
  weakly: ["weakly determined", "is-care"],
  not: ["not determined", "is-bad"],
};

// What a log can tell of the model before anything is solved, and the experiment that would tell more.
export const check = (root, now) => {
  let asked = "",
    shown = "",
    found = null,
    limits = null,
    opened = false;
  const [status, about, design, designed] = places(4);
  put(
    root,
    h("h2", "Check"),
    h("p.how", "Signals, excitation, and the intervals to expect, by least squares over the chosen logs."),
    status,
    about,
    design,
    designed,
  );
  const lack = (title, text) =>
    h(".card.bad", h("h3", title), h("p", text), toStage("data", "Choose their columns in Data"));
  const drawFound = () => {
    if (!found.signals) {
      put(about, lack("No topic is mapped to a signal yet", found.source));
      found = null;
      return;
    }
    const { fitness } = found,
      logs = [found, ...found.others],
      lacking = fitness.missing.filter((x) => !fitness.derivable.includes(x));
    const rows = Object.entries(fitness.excitation).map(([name, x]) => {
      const [words, look] = WORDS[fitness.verdicts[name]],
        half = Math.abs(x.estimate * x.relative_error) * 1.96;
      return [
        name,
        number(x.estimate),
        Number.isFinite(half) && x.relative_error !== null
          ? `${number(x.estimate - half)} … ${number(x.estimate + half)}`
          : "–",
        x.unit,
        x.relative_error === null ? "–" : `${number(100 * x.relative_error, 2)} %`,
        h(`span.${look}`, words),
      ];
    });
    put(
      about,
      lacking.length > 0 && lack("Signals are lacking", lacking.join(", ")),
      fitness.derivable.length > 0 &&
        h("p", `Not measured, estimated where it is needed: ${fitness.derivable.join(", ")}.`),
      fitness.reason &&
        h(
          ".card.care",
          h("p", fitness.reason),
          /fix/.test(fitness.reason) && toStage("model", "Give known values in Model"),
        ),
      rows.length > 0 &&
        table(["parameter", "least squares", "interval to expect", "unit", "error", ""], rows),
      fitness.caveat && h("p.how", fitness.caveat),
      logs.map((log) => [
        h("h3", logs.length > 1 ? `Signals of ${log.source}` : "Signals"),
        notes(log.notes),
        table(
          ["signal", "unit", "minimum", "maximum", "std", "Hz", "missing", "spikes", "frozen"],
          Object.entries(log.signals).map(([name, x]) => [
            name,
            x.unit || "?",
            number(x.minimum),
            number(x.maximum),
            number(x.standard_deviation),
            number(x.rate),
            String(x.n_missing || "–"),
            String(x.n_spikes || "–"),
            x.frozen ? `${number(x.frozen, 3)} s` : "–",
          ]),
        ),
      ]),
    );
  };
  const drawDesign = async (state) => {
    const equations = await printed(state, "model");
    if (!equations) {
      put(design);
      return;
    }
    if (!limits) {
      limits = {};
      const units = { ...equations.signals, ...equations.inputs },
        names = Object.keys(equations.signals).filter((name) => !isRate(name));
      for (const name of [...Object.keys(equations.inputs), ...names]) {
        const ranges = found ? [found, ...found.others].map((log) => log.signals[name]).filter(Boolean) : [],
          least = Math.min(...ranges.map((x) => x.minimum)),
          most = Math.max(...ranges.map((x) => x.maximum));
        if (most > least && units[name] !== "1")
          limits[name] = [least, most].map((y) => Number(y.toPrecision(3)));
      }
    }
    const field = (name, k) =>
      numberField(limits[name][k], (text) => (limits[name][k] = Number(text)), {
        "aria-label": `${k ? "largest" : "smallest"} ${name}`,
      });
    const remove = (name) => {
      delete limits[name];
      drawDesign(state);
    };
    const known = Object.fromEntries(
      Object.entries(found?.fitness.excitation || {})
        .filter(([, x]) => x.estimate !== null)
        .map(([name, x]) => [name, x.estimate]),
    );
    const parameters = { ...known, ...(state.project.fix || {}) };
    put(
      design,
      h("h3", "The experiment that would tell more"),
      h(
        "p.how",
        "A motion within limits from which the parameters are identified best. The limits are the ranges of the logs, or those of the robot's description.",
      ),
      !state.robot &&
        h(
          "details",
          {
            open: opened,
            ontoggle: (event) => {
              opened = event.target.open;
            },
          },
          h("summary", `Limits of ${Object.keys(limits).length} quantities`),
          table(
            null,
            Object.keys(limits).map((name) => [
              name,
              field(name, 0),
              "to",
              field(name, 1),
              button("no limit", () => remove(name)),
            ]),
          ),
        ),
      h(
        ".row",
        button("Design an experiment", () =>
          run("design", { limits: state.robot ? {} : limits, parameters }),
        ),
        outcome(state.jobs.design, "Designing, up to half a minute"),
      ),
    );
  };
  const drawDesigned = async (state) => {
    const made = await printed(state, "design");
    put(
      designed,
      made && [
        table(
          ["parameter", "standard error to expect", "with plain sines", "unit"],
          Object.entries(made.parameters).map(([name, x]) => [
            name,
            number(x.standard_error, 3),
            number(x.multisine_standard_error, 3),
            x.unit,
          ]),
        ),
        h("p", download("experiment.csv")),
      ],
    );
  };
  return async (state) => {
    const wanted = state.commands.check.shell,
      job = state.jobs.check,
      ready = !wanted.startsWith("#") && (!state.code || state.code.confirmed);
    if (!ready) {
      unchanged(status);
      shown = "";
      put(
        status,
        h(
          ".empty",
          wanted.startsWith("#") ? wanted.slice(2) : "Confirm in Model that your own code may run.",
        ),
      );
      put(about);
      return;
    }
    if (asked !== wanted && (!job || job.command !== wanted)) {
      asked = wanted;
      run("check");
    }
    if (!unchanged(status, job?.number, job?.status))
      put(
        status,
        outcome(job, "Reading the log and counting what it can tell"),
        h(
          ".row",
          button("Check again", () => run("check")),
        ),
      );
    if (job?.status === "failed") put(about);
    if (job?.status === "done" && job.command === wanted && shown !== `${job.number}`) {
      shown = `${job.number}`;
      found = await printed(state, "check");
      limits = null;
      drawFound();
    }
    if (
      !unchanged(
        design,
        job?.number,
        job?.status,
        state.jobs.model?.status,
        state.jobs.design?.number,
        state.jobs.design?.status,
        state.project.fix,
        Boolean(found),
      )
    )
      await drawDesign(state);
    drawDesigned(state);
  };
};
