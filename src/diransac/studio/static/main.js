import { button, clean, h, put, run, say, unchanged } from "./page.js";
import { data } from "./data.js";
import { model } from "./model.js";
import { check } from "./check.js";
import { solve } from "./solve.js";
import { results } from "./results.js";
import { use } from "./use.js";

const STAGES = {
  data: ["Data", data],
  model: ["Model", model],
  check: ["Check", check],
  solve: ["Solve", solve],
  results: ["Results", results],
  use: ["Use", use],
};
const JOBS = { model: "model", check: "check", solve: "solve", results: "validate", use: "export" };
let state = null,
  shown = null,
  update = () => {},
  language = "shell",
  asked = "";
const chosen = () => (location.hash.slice(1) in STAGES ? location.hash.slice(1) : "data");

const look = (key) => {
  const { project, jobs, results: found } = state,
    job = jobs[JOBS[key]];
  if (job?.status === "running" || job?.status === "failed") return job.status;
  if (key === "data") return (project.logs || []).length ? "done" : "";
  if (key === "model") return job?.status === "done" ? "done" : project.model ? "care" : "";
  if (key === "solve") return found.length ? (state.stale ? "care" : "done") : "";
  return job?.status === "done" ? "done" : "";
};
const drawNav = () =>
  unchanged(document.getElementById("stages"), chosen(), Object.keys(STAGES).map(look)) ||
  put(
    document.getElementById("stages"),
    Object.entries(STAGES).map(([key, [name]]) => {
      const link = h("a", { href: `#${key}`, className: look(key) }, h("i"), name);
      if (key === chosen()) link.setAttribute("aria-current", "page");
      return link;
    }),
  );
const drawCommands = () => {
  const commands = state.commands[chosen()],
    text = clean(commands[language]);
  if (unchanged(document.getElementById("commands"), text, language)) return;
  const tab = (key, name) => {
    const choose = () => {
      language = key;
      drawCommands();
    };
    return button(name, choose, { "aria-pressed": language === key });
  };
  const copy = button("Copy", async () => {
    await navigator.clipboard
      .writeText(text)
      .catch(() => say("the browser does not allow copying; select the text"));
    copy.textContent = "Copied";
  });
  put(
    document.getElementById("commands"),
    h(".row", h("span", "The same by hand:"), tab("shell", "Command line"), tab("python", "Python"), copy),
    h("pre", { tabIndex: 0 }, h("code", text)),
  );
};
const readModel = () => {
  const wanted = state.commands.model.shell,
    job = state.jobs.model;
  if (
    asked === wanted ||
    !state.project.model ||
    (job && job.command === wanted) ||
    (state.code && !state.code.confirmed)
  )
    return;
  asked = wanted;
  run("model");
};
const draw = () => {
  if (!state) return;
  readModel();
  put(document.getElementById("place"), `${state.folder} · kept in ${state.file}`);
  drawNav();
  drawCommands();
  if (shown !== chosen()) {
    const first = shown === null;
    shown = chosen();
    const root = document.getElementById("stage");
    put(root);
    document.title = `${STAGES[shown][0]} · diransac studio`;
    update = STAGES[shown][1](root, () => state);
    if (!first) root.focus({ preventScroll: true });
    scrollTo(0, 0);
  }
  update(state);
};
addEventListener("hashchange", draw);

const LOOKS = { "light dark": "◐", light: "☀", dark: "☾" },
  looks = document.getElementById("look");
const setLook = (scheme) => {
  document.documentElement.style.colorScheme = scheme;
  localStorage.setItem("look", scheme);
  looks.textContent = LOOKS[scheme];
  dispatchEvent(new Event("look"));
};
looks.addEventListener("click", () => {
  const all = Object.keys(LOOKS);
  setLook(all[(all.indexOf(document.documentElement.style.colorScheme) + 1) % 3]);
});
setLook(localStorage.getItem("look") in LOOKS ? localStorage.getItem("look") : "light dark");
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => dispatchEvent(new Event("look")));

const events = new EventSource("api/events"),
  connection = document.getElementById("connection");
events.addEventListener("open", () => {
  connection.className = "";
  put(connection, "connected");
});
events.addEventListener("error", () => {
  connection.className = "lost";
  put(connection, "connection lost; trying again – is diransac studio still running?");
});
events.addEventListener("message", (event) => {
  state = JSON.parse(event.data);
  draw();
});
