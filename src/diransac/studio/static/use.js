import { h, link, outcome, printed, put, run } from "./page.js";

const KINDS = [
  ["dynamics.c", "C99", "Derivative of the state and a Runge-Kutta step, without allocation."],
  ["dynamics.py", "Python", "The same with NumPy, over leading axes."],
  ["dynamics.casadi", "CasADi", "A serialised function with an argument for each parameter."],
  ["model.yaml", "YAML", "Estimates, standard errors, covariance, 1000 draws, delay and lag of the inputs."],
];

// Files for other programs.
export const use = (root, now) => {
  const about = h("div"),
    done = h("div");
  let drawn = "";
  put(
    root,
    h("h2", {}, "Use"),
    h("p.how", {}, "Files for other programs; they are written into diransac-results."),
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
    put(
      about,
      h(
        ".scroll",
        {},
        h(
          "table",
          {},
          h(
            "tbody",
            {},
            kinds.map(([name, kind, text]) => {
              const field = h("input", {
                value: name,
                "aria-label": `name of the file, ${kind}`,
                maxLength: 99,
              });
              return h(
                "tr",
                {},
                h("th", { scope: "row" }, kind),
                h("td", {}, text),
                h("td", {}, field),
                h(
                  "td",
                  {},
                  h(
                    "button",
                    { type: "button", onclick: () => run("export", { name: field.value.trim() }) },
                    "Write",
                  ),
                ),
              );
            }),
            h(
              "tr",
              {},
              h("th", { scope: "row" }, "Result"),
              h("td", {}, "Everything that was found, for diransac."),
              h("td"),
              h(
                "td",
                {},
                state.results.map((x) =>
                  h("a.button", { href: link("download", { name: x }) }, x.replace(/^.*\//, "")),
                ),
              ),
            ),
            h(
              "tr",
              {},
              h("th", { scope: "row" }, "Report"),
              h("td", {}, "One page that loads nothing, to be sent."),
              h("td"),
              h(
                "td",
                {},
                h(
                  "a.button",
                  {
                    href: link("download", {
                      name: state.results[0].replace("model", "report").replace(".json", ".html"),
                    }),
                  },
                  "report.html",
                ),
              ),
            ),
          ),
        ),
      ),
    );
  };
  return async (state) => {
    if (!state.results.length) {
      drawn = "";
      put(about, h(".empty", {}, "No result yet. ", h("a.button", { href: "#solve" }, "Solve")));
      put(done);
      return;
    }
    const key = JSON.stringify([state.results, state.project.model]);
    if (key !== drawn) {
      drawn = key;
      drawKinds(state);
    }
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
          {},
          text
            .trim()
            .split("\n")
            .map((x) => h("p", {}, x)),
          name &&
            h("p", {}, h("a.button", { href: link("download", { name: name[1] }) }, `Download ${name[1]}`)),
        ),
    );
  };
};
