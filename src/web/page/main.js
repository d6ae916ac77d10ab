// The frame around the pages: navigation, lamps, language, theme.

import { askJson, chooseLanguage, count, every, h, number, otherLanguage, remember, remembered, t, time, whenSilent } from "./common.js";
import { events } from "./events.js";
import { overview } from "./overview.js";
import { parcel, parcels } from "./parcels.js";
import { plc } from "./plc.js";
import { setup } from "./setup.js";
import { site } from "./site.js";
import { trend } from "./trend.js";

const PAGES = { overview, parcels, trend, plc, events, setup, site };
// One of a list is part of it.
const OTHERS = { parcel };
const LIST_OF = { parcel: "parcels" };
const THEMES = ["auto", "light", "dark"];
const element = (id) => document.getElementById(id);
let leave = new AbortController();
let newest = null;
// When the state's time last moved: lamps of an old state are worth nothing.
const STALE_MS = 3000;
let [renewed, stale, silentSince] = [performance.now(), false, null];
let theme = THEMES.includes(remembered("theme")) ? remembered("theme") : "auto";

function showTheme() {
  if (theme === "auto") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = theme;
  element("theme").textContent = t(`theme.${theme}`);
  element("theme").title = t("theme.hint");
}

function showLamps(state) {
  const word = (lamp) => (stale ? t("lamp.unknown") : lamp.on ? t("lamp.on") : t("lamp.off"));
  element("lamps").replaceChildren(...state.lamps.map((lamp) =>
    h("li", { class: `${lamp.name} ${lamp.on && !stale ? "on" : ""}`, title: lamp.reasons.map((code) => t(`reason.${code}`)).join("\n") },
      h("span", { class: "dot", "aria-hidden": "true" }),
      `${t(`lamp.${lamp.name}`)}`,
      h("span", { class: "soft" }, word(lamp)))));
  element("footer").textContent = t("footer", {
    version: state.version, clock: time(state.utc_ms), hours: number(state.uptime_s / 3600, 1), boots: count(state.boots),
  });
}

function show() {
  const [name, ...where] = location.hash.slice(1).split("/");
  const all = { ...PAGES, ...OTHERS };
  const page = Object.hasOwn(all, name) ? name : "overview";
  leave.abort();
  leave = new AbortController();
  element("dialog").close();
  element("nav").replaceChildren(...Object.keys(PAGES).map((key) =>
    h("a", { href: `#${key}`, "aria-current": key === (LIST_OF[page] ?? page) ? "page" : null }, t(`page.${key}`))));
  document.title = `Beltgauge – ${t(`page.${page}`)}`;
  element("language").textContent = t("language.other");
  element("language").lang = otherLanguage();
  showTheme();
  const main = element("main");
  main.replaceChildren(h("h1", {}, t(`page.${page}`)));
  all[page](main, leave.signal, where);
  // What is known is shown at once, in the language that was chosen.
  if (newest) tell(newest);
}

function showAge() {
  const isStale = performance.now() - renewed > STALE_MS;
  if (isStale !== stale) {
    stale = isStale;
    document.documentElement.classList.toggle("stale", stale);
    if (newest) showLamps(newest);
  }
  const banner = element("offline");
  banner.hidden = !stale && silentSince === null;
  if (banner.hidden) return;
  const words = silentSince === null && newest ? t("stale", { since: time(newest.utc_ms) })
    : t("offline", { since: silentSince === null ? "…" : time(silentSince) });
  // It is read aloud when it changes, not twice a second.
  if (banner.textContent !== words) banner.textContent = words;
}

function tell(state) {
  // The clock may be set back: that it moves is what counts.
  if (state.utc_ms !== newest?.utc_ms) renewed = performance.now();
  newest = state;
  showLamps(state);
  document.dispatchEvent(new CustomEvent("state", { detail: state }));
}

element("theme").addEventListener("click", () => {
  theme = THEMES[(THEMES.indexOf(theme) + 1) % THEMES.length];
  remember("theme", theme);
  showTheme();
  document.dispatchEvent(new Event("theme"));
});
element("language").addEventListener("click", async () => {
  await chooseLanguage(otherLanguage());
  show();
});
window.addEventListener("hashchange", () => {
  show();
  element("main").focus();
});
whenSilent((since) => {
  silentSince = since;
  showAge();
});

await chooseLanguage();
show();
setInterval(showAge, 500);
every(1000, new AbortController().signal, async () => tell(await askJson("/api/state")));
