// Elements, requests and text that all stages share. Text of files reaches the page as text nodes alone.
const HIDDEN = /[\u0000-\u001f\u007f-\u009f\u00ad\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff]/g;
export const clean = (text) =>
  String(text).replace(HIDDEN, (x) =>
    x === "\n" ? x : `\\u${x.charCodeAt(0).toString(16).padStart(4, "0")}`,
  );

// An element by its tag and classes; attributes and listeners, where there are any; and children.
export const h = (name, ...children) => {
  const about = children[0]?.constructor === Object ? children.shift() : {},
    [tag, ...classes] = name.split(".");
  const element = document.createElement(tag || "div");
  if (classes.length) element.className = classes.join(" ");
  for (const [key, value] of Object.entries(about)) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key in element && key !== "list") element[key] = value;
    else if (value !== null && value !== undefined) element.setAttribute(key, value);
  }
  put(element, ...children);
  return element;
};
export const put = (element, ...children) => {
  const nodes = children.flat(9).filter((x) => x !== null && x !== undefined && x !== false);
  element.replaceChildren(...nodes.map((x) => (x instanceof Node ? x : document.createTextNode(clean(x)))));
};

// What is shown is drawn again only where it is another, so that no menu closes under the hand.
const drawn = new WeakMap();
export const unchanged = (element, ...about) => {
  const key = JSON.stringify(about),
    same = drawn.get(element) === key && element.childNodes.length > 0;
  drawn.set(element, key);
  return same;
};

const answer = async (response) => {
  if (response.ok) return response;
  const said = await response.json().catch(() => ({}));
  throw new Error(said.error || `the server refused (${response.status})`);
};
const address = (name, query) => `api/${name}${query ? `?${new URLSearchParams(query)}` : ""}`;
export const get = async (name, query) => (await answer(await fetch(address(name, query)))).json();
export const numbers = async (name, query, signal) =>
  (await answer(await fetch(address(name, query), { signal }))).arrayBuffer();
export const link = address;
// What a promise has, or a message about its failure.
export const told = (promise) => promise.catch((error) => say(error.message));
export const post = (name, body) =>
  told(
    fetch(`api/${name}`, {
      method: "POST",
      headers: { "content-type": "application/json" },
      body: JSON.stringify(body),
    })
      .then(answer)
      .then(() => true),
  );
let fading;
export const say = (text) => {
  const box = document.getElementById("message");
  put(box, text);
  box.hidden = !text;
  clearTimeout(fading);
  fading = setTimeout(() => {
    box.hidden = true;
  }, 9000);
};
export const change = (changes) => post("project", changes);
export const run = (kind, given = {}) => post("run", { kind, ...given });

export const number = (x, digits = 4) => {
  if (x === null || x === undefined || Number.isNaN(x)) return "–";
  const text =
    Math.abs(x) >= 1e5 || (x !== 0 && Math.abs(x) < 1e-3)
      ? x.toExponential(digits - 1).replace(/\.?0+e/, "e")
      : String(+x.toPrecision(digits));
  return text.replace(/-/g, "−");
};
// A table whose rows begin with a heading; columns have names where a header is given.
export const table = (header, rows) => {
  const cell = (x) => h(typeof x === "string" && (/^[−\d–]/.test(x) || x.length < 16) ? "td.number" : "td", x);
  const row = ([name, ...cells]) => h("tr", h("th", { scope: "row" }, name), cells.map(cell));
  const columns = header?.map((x) => h("th", { scope: "col" }, x));
  return h(".scroll", h("table", columns && h("thead", h("tr", columns)), h("tbody", rows.map(row))));
};
export const button = (text, onclick, about) => h("button", { type: "button", onclick, ...about }, text);
export const numberField = (value, onchange, about) =>
  h("input", {
    type: "number",
    step: "any",
    value: value ?? "",
    onchange: (event) => onchange(event.target.value),
    ...about,
  });
// A menu of pairs of a value and its text, or of texts.
export const choice = (value, options, onchange, about) => {
  const entries = options
      .map((x) => [x].flat())
      .map(([key, text = key]) => h("option", { value: key }, text)),
    element = h("select", { onchange: (event) => onchange(event.target.value), ...about }, entries);
  element.value = value;
  return element;
};
export const notes = (texts) => {
  const items = texts.map((x) => h("li", x));
  return texts.length > 0 && h("ul.notes", items);
};
// Places of a stage, each of which is drawn by itself.
export const places = (n) => Array.from({ length: n }, () => h("div"));
export const toStage = (stage, text) => h("a.button", { href: `#${stage}` }, text);
export const download = (name, text = `Download ${name}`) =>
  h("a.button", { href: link("download", { name }) }, text);
export const noResult = () => h(".empty", "No result yet. ", toStage("solve", "Solve"));
// Whether a signal can be derived from others, by its name.
export const isRate = (name) => /_d+ot$/.test(name);

// Contents of the latest job of a kind, fetched once for each job.
const known = {};
export const printed = async (state, kind) => {
  const job = state.jobs[kind];
  if (!job || job.status !== "done") return null;
  if (!known[kind] || known[kind].number !== job.number)
    known[kind] = { number: job.number, printed: get("job", { kind }).then((x) => x.printed) };
  return known[kind].printed;
};
export const outcome = (job, busy) => {
  if (!job) return null;
  if (job.status === "running") return h("p.how", `${busy} …`);
  return job.status === "failed" ? h("p.error", job.error) : null;
};
