import {
  button,
  download,
  h,
  noResult,
  outcome,
  places,
  printed,
  put,
  run,
  table,
  unchanged,
} from "./page.js";

const KINDS = [
  ["dynamics.c", "C99", "Derivative of the state and a Runge-Kutta step, without allocation."],
  ["dynamics.py", "Python", "The same with NumPy, over leading axes."],
  ["dynamics.casadi", "CasADi", "A serialised function with an argument for each parameter."],
  ["model.yaml", "YAML", "Estimates, standard errors, covariance, 1000 draws, delay and lag of the inputs."],
];

// Files for other programs.
export const use = (root, now) => {
  const [about, done] = places(2);
  put(
    root,
    h("h2", "Use"),
    h("p.how", "Files for other programs; they are written into diransac-results."),
    about,
    done,
  );
  const drawKinds = (state) => {
    const { model } = state.project,
      ending = state.robot ? model.slice(model.lastIndexOf(".")).toLowerCase() : "";
    const kinds = [
      ...KINDS,
      ...([".xml", ".urdf"].includes(ending)
        ? [[`calibrated${ending}`, "Calibrated description", `${model} with the identified values in it.`]]
        : []),
    ];
    const row = ([name, kind, text]) => {
      const field = h("input", { value: name, "aria-label": `name of the file, ${kind}`, maxLength: 99 });
      return [kind, text, field, button("Write", () => run("export", { name: field.value.trim() }))];
    };
    const report = state.results[0].replace("model", "report").replace(".json", ".html"),
      whole = state.results.map((x) => download(x, x.replace(/^.*\//, "")));
    put(
      about,
      table(null, [
        ...kinds.map(row),
        ["Result", "Everything that was found, for diransac.", [], whole],
        ["Report", "One page that loads nothing, to be sent.", [], download(report, "report.html")],
      ]),
    );
  };
  return async (state) => {
    if (!state.results.length) {
      unchanged(about);
      put(about, noResult());
      put(done);
      return;
    }
    if (!unchanged(about, state.results, state.project.model)) drawKinds(state);
    const job = state.jobs.export,
      text = await printed(state, "export"),
      name = job && /-o ['"]?diransac-results\/([^'"]+?)['"]?( --into|$)/.exec(job.command);
    put(
      done,
      outcome(job, "Writing"),
      text &&
        job.status === "done" &&
        h(
          ".card.good",
          text
            .trim()
            .split("\n")
            .map((x) => h("p", x)),
          name && h("p", download(name[1])),
        ),
    );
  };
};
