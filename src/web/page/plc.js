// What the PLC reads and writes: every register by its name.

import { askJson, every, h, number, t } from "./common.js";

export function plc(main, signal) {
  const parts = { latest: h("tbody"), status: h("tbody"), command: h("tbody"), clients: h("tbody") };
  const [about, written, nobody] = [h("p", { class: "soft" }), h("p"), h("p", { class: "soft" }, t("plc.nobody"))];
  const card = (name, ...content) => h("section", { class: "card" }, h("h2", {}, t(`plc.${name}`)), ...content);
  main.append(
    card("clients", table(parts.clients, ["client", "requests", "silent", "writes"]), nobody),
    card("latest", about, table(parts.latest, COLUMNS)),
    card("command", written, table(parts.command, COLUMNS)),
    card("status", table(parts.status, COLUMNS)));
  every(1000, signal, async () => {
    const plc = await askJson("/api/plc", signal);
    about.textContent = t("plc.about", { version: plc.map_version, base: plc.base_address }) + (plc.can_interface ? ` ${t("plc.can", { name: plc.can_interface })}` : "");
    written.textContent = plc.written ? t("plc.written", { sender: plc.written.sender, seconds: number(plc.written.seconds_ago, 1) }) : t("plc.not_written");
    for (const name of ["latest", "status", "command"]) {
      parts[name].replaceChildren(...plc[name].map((field) => register(field, plc.base_address)));
    }
    parts.clients.replaceChildren(...plc.clients.map((client) => h("tr", {},
      h("td", {}, client.address), h("td", { class: "number" }, `${client.requests}`),
      h("td", { class: "number" }, `${number(client.silent_s, 1)} s`),
      h("td", {}, t(client.may_write ? "plc.may_write" : "plc.reads_only")))));
    nobody.hidden = plc.clients.length > 0;
  });
}

const COLUMNS = ["address", "name", "value", "words", "meaning"];
const NUMERIC = ["value", "requests", "silent"];

function table(body, columns) {
  return h("div", { class: "scroll" }, h("table", {},
    h("thead", {}, h("tr", {}, columns.map((name) => h("th", { scope: "col", class: NUMERIC.includes(name) ? "number" : null }, t(`plc.column.${name}`))))),
    body));
}

function register({ address, name, value, registers, unit, digits, meaning }, base) {
  const shown = unit === "bits" ? `0b${value.toString(2)}` : `${number(value, digits)} ${unit}`;
  const words = registers.map((word) => word.toString(16).toUpperCase().padStart(4, "0")).join(" ");
  return h("tr", {},
    h("td", {}, `${base + address}`), h("td", {}, h("code", {}, name)), h("td", { class: "number" }, shown),
    h("td", {}, h("code", {}, words)), h("td", { class: "meaning" }, meaning));
}
