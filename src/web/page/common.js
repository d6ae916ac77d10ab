// What all pages use: texts in the visitor's language, elements, requests.

const LANGUAGES = ["en", "de"];
let texts = {};
let language = "en";

export async function chooseLanguage(wanted) {
  const preferred = wanted ?? remembered("language") ?? navigator.language.slice(0, 2);
  language = LANGUAGES.includes(preferred) ? preferred : "en";
  const chosen = language;
  const found = await (await fetch(`/${chosen}.json`)).json();
  // Another one was chosen meanwhile.
  if (chosen !== language) return;
  texts = found;
  document.documentElement.lang = language;
  if (wanted) remember("language", wanted);
}

export const currentLanguage = () => language;
export const otherLanguage = () => LANGUAGES[(LANGUAGES.indexOf(language) + 1) % LANGUAGES.length];

// A text; {name} in it is replaced. A key without a text shows itself: better than nothing.
export function t(key, values = {}) {
  const text = texts[key] ?? key;
  return text.replace(/\{(\w+)\}/g, (whole, name) => values[name] ?? whole);
}
export const has = (key) => key in texts;

export function remember(key, value) {
  try { localStorage.setItem(`beltgauge.${key}`, value); } catch { /* a private window */ }
}
export function remembered(key) {
  try { return localStorage.getItem(`beltgauge.${key}`); } catch { return null; }
}

// An element. Children that are no elements become text, never markup.
export function h(name, attributes = {}, ...children) {
  return fill(document.createElement(name), attributes, children);
}
export function svg(name, attributes = {}, ...children) {
  return fill(document.createElementNS("http://www.w3.org/2000/svg", name), attributes, children);
}
function fill(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return element;
}

export function number(value, digits = 1) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  return value.toLocaleString(language, { minimumFractionDigits: digits, maximumFractionDigits: digits });
}
export const count = (value) => number(value, 0);
// Year first, as everybody reads it alike; in the visitor's time zone.
export const time = (utcMs) => new Date(utcMs).toLocaleString("sv-SE");
export function bytes(value) {
  return value >= 1 << 30 ? `${number(value / 2 ** 30, 1)} GiB` : `${number(value / 2 ** 20, 1)} MiB`;
}

// Whether the machine answers; what is shown is old when it does not.
let silentSince = null;
let tellSilence = () => {};
export function whenSilent(tell) { tellSilence = tell; }
function heard(ok) {
  if (ok) silentSince = null;
  else silentSince ??= Date.now();
  tellSilence(silentSince);
}

export async function ask(path, signal) {
  let answer;
  try {
    const slow = AbortSignal.timeout(8000);
    answer = await fetch(path, { signal: signal ? AbortSignal.any([signal, slow]) : slow });
  } catch (error) {
    if (!signal?.aborted) heard(false);
    throw error;
  }
  heard(true);
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

// Change something, or ask what only who has signed in may know.
export async function send(method, path, token, body = null, signal = null) {
  const headers = token ? { "X-Beltgauge-Token": token } : {};
  const answer = await fetch(path, { method, body, headers, signal });
  if (!answer.ok) throw Object.assign(new Error(await answer.text()), { status: answer.status });
  return answer;
}
export const askJson = async (path, signal) => (await ask(path, signal)).json();

// Do something now and again and again, until the page is left; not while nobody can see it.
export function every(ms, signal, task) {
  const run = async () => {
    while (!signal.aborted) {
      if (document.visibilityState === "visible") {
        try { await task(); } catch { /* the banner tells */ }
      } else {
        await visible(signal);
        continue;
      }
      await pause(ms, signal);
    }
  };
  run();
}
export function visible(signal) {
  return new Promise((resolve) => {
    const look = () => {
      if (document.visibilityState !== "visible" && !signal.aborted) return;
      document.removeEventListener("visibilitychange", look);
      resolve();
    };
    document.addEventListener("visibilitychange", look);
    signal.addEventListener("abort", look, { once: true });
    look();
  });
}
export function pause(ms, signal) {
  return new Promise((resolve) => {
    const timer = setTimeout(resolve, ms);
    signal.addEventListener("abort", () => { clearTimeout(timer); resolve(); }, { once: true });
  });
}
