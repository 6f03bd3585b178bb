// Elements, requests and text that all stages share. Text of files reaches the page as text nodes alone.
const HIDDEN = /[\u0000-\u001f\u007f-\u009f\u00ad\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff]/g;
export const clean = (text) =>
  String(text).replace(HIDDEN, (x) =>
    x === "\n" ? x : `\\u${x.charCodeAt(0).toString(16).padStart(4, "0")}`,
  );

export const h = (name, about = {}, ...children) => {
  const [tag, ...classes] = name.split(".");
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
export const post = async (name, body) => {
  try {
    await answer(
      await fetch(`api/${name}`, {
        method: "POST",
        headers: { "content-type": "application/json" },
        body: JSON.stringify(body),
      }),
    );
    return true;
  } catch (error) {
    say(error.message);
    return false;
  }
};
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
      ? x.toExponential(digits - 1)
      : String(+x.toPrecision(digits));
  return text.replace(/-/g, "−");
};
export const table = (header, rows, caption) =>
  h(
    ".scroll",
    {},
    h(
      "table",
      {},
      caption && h("caption", {}, caption),
      h(
        "thead",
        {},
        h(
          "tr",
          {},
          header.map((x) => h("th", { scope: "col" }, x)),
        ),
      ),
      h(
        "tbody",
        {},
        rows.map((row) =>
          h(
            "tr",
            {},
            row.map((x, k) =>
              k
                ? h(typeof x === "string" && /^[−\d–]/.test(x) ? "td.number" : "td", {}, x)
                : h("th", { scope: "row" }, x),
            ),
          ),
        ),
      ),
    ),
  );
export const choice = (value, options, about) => {
  const element = h(
    "select",
    about,
    options.map(([key, text]) => h("option", { value: key }, text)),
  );
  element.value = value;
  return element;
};
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
  if (job.status === "running") return h("p.how", {}, `${busy} …`);
  return job.status === "failed" ? h("p.error", {}, job.error) : null;
};
