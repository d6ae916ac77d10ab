// What happened since start, newest first; and all of it for somebody elsewhere.

import { askJson, every, h, has, t, time } from "./common.js";

const KEPT = 300;

export function events(main, signal) {
  const body = h("tbody");
  const empty = h("p", { class: "soft" }, t("events.none"));
  let [since, run] = [0, null];
  main.append(h("section", { class: "card" }, h("h2", {}, t("events.title")),
    h("div", { class: "scroll" }, h("table", {},
      h("thead", {}, h("tr", {}, ["time", "what", "detail"].map((name) => h("th", { scope: "col" }, t(`events.${name}`))))), body)), empty));
  main.append(h("section", { class: "card" }, h("h2", {}, t("bundle.title")), h("p", {}, t("bundle.what")), h("p", { class: "soft" }, t("bundle.secrets")),
    h("p", {}, h("a", { href: "/api/bundle.tar.gz", download: "beltgauge-bundle.tar.gz" }, t("bundle.take")))));
  every(1000, signal, async () => {
    const list = await askJson(`/api/events?since=${since}`, signal);
    if (run !== null && run !== list.run) {
      since = 0;
      body.replaceChildren();
    } else {
      for (const event of list.items) body.prepend(row(event));
      while (body.children.length > KEPT) body.lastChild.remove();
      since = list.next;
    }
    run = list.run;
    empty.hidden = body.children.length > 0;
  });
}

function row({ utc_ms, kind, code, detail }) {
  const about = { began: `reason.${code}`, ended: `reason.${code}`, command: `command.${code}`, import: `import.${code}` }[kind];
  const what = t(`event.${kind}`) + (about && has(about) ? `: ${t(about)}` : "");
  return h("tr", {}, h("td", {}, time(utc_ms)), h("td", {}, what), h("td", { class: "meaning" }, detail));
}
