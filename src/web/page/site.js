// The site: its configuration, calibrating it here, the one before, a backup. All of it goes the way of a stick.

import { askJson, h, pause, send, t } from "./common.js";
import { forCalibration, kept, saveForStick, textFile, untar } from "./stills.js";

const CONFIGURATION = "beltgauge.toml";
const POLL_MS = 400;
// A program that starts again is back within this.
const START_MS = 60000;
// Longer texts are not compared.
const LINES_MAX = 1500;

export function site(main, signal) {
  const room = h("div", { class: "stack", id: "site" });
  main.append(room);
  const enter = async () => {
    try {
      const { can_be_changed: can, token } = await askJson("/api/session", signal);
      if (!can) room.replaceChildren(h("p", { class: "card" }, t("site.by_file")));
      else if (token === null) room.replaceChildren(signIn(enter, signal));
      else await whoHasSignedIn(room, token, enter, signal);
    } catch (error) {
      if (!signal.aborted) room.replaceChildren(h("p", { class: "card warning" }, String(error.message)));
    }
  };
  enter();
}

function signIn(enter, signal) {
  const code = h("input", { id: "code", autocomplete: "off", autocapitalize: "characters", spellcheck: "false", required: true, maxlength: 20 });
  const words = h("p", { class: "warning", "aria-live": "polite" });
  const form = h("form", { class: "card" }, h("h2", {}, t("site.sign_in")), h("p", {}, t("site.code.where")),
    h("div", { class: "fields" }, h("label", {}, t("site.code"), code)), h("button", {}, t("site.sign_in")), words);
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    try {
      await send("POST", "/api/session", null, code.value, signal);
      await enter();
    } catch (error) {
      words.textContent = error.status === 403 ? t("site.code.wrong") : String(error.message);
    }
  });
  return form;
}

async function whoHasSignedIn(room, token, enter, signal) {
  const current = await (await send("GET", "/api/site", token, null, signal)).json();
  const words = h("p", { "aria-live": "polite", id: "site-words" });
  const report = h("pre", { id: "report", tabindex: "0", "aria-label": t("site.report") }, current.report || t("site.report.none"));
  const buttons = [];
  const button = (key, enabled, action) => {
    const made = h("button", { type: "button", id: `site-${key}`, disabled: !enabled, onclick: action }, t(`site.${key}`));
    if (enabled) buttons.push(made);
    return made;
  };
  const text = h("textarea", { id: "configuration", rows: 22, spellcheck: "false", "aria-label": t("site.configuration") });
  text.value = current.configuration ?? "";
  const tell = (key, values) => { words.textContent = t(`site.words.${key}`, values); };

  // Bring files, have the change done, wait for its end.
  async function change(name, files) {
    for (const one of buttons) one.disabled = true;
    try {
      if (files !== null) await bring(files);
      await send("POST", `/api/site/${name}`, token, null, signal);
      tell("busy");
      const ended = await end();
      report.textContent = ended.work.report || ended.report;
      const isGood = ended.work.state === "good";
      tell(isGood ? (name === "check" ? "would" : "done") : "refused");
      words.classList.toggle("warning", !isGood);
      if (isGood && name !== "check") {
        if (ended.work.restarts) await restarted();
        await enter();
        return;
      }
    } catch (error) {
      if (signal.aborted) return;
      if (error.status === 401) return enter();
      report.textContent = String(error.message);
      tell("refused");
    }
    for (const one of buttons) one.disabled = false;
  }
  async function bring(files) {
    await send("POST", "/api/tray", token, null, signal);
    for (const [k, { name, bytes }] of files.entries()) {
      tell("bringing", { n: k + 1, all: files.length });
      await send("PUT", `/api/tray/${name.split("/").map(encodeURIComponent).join("/")}`, token, bytes, signal);
    }
  }
  async function end() {
    for (;;) {
      const now = await (await send("GET", "/api/site", token, null, signal)).json();
      if (now.work.state !== "busy") return now;
      await pause(POLL_MS, signal);
    }
  }
  // The one that starts knows of no work.
  async function restarted() {
    for (const until = performance.now() + START_MS; performance.now() < until && !signal.aborted;) {
      await pause(POLL_MS, signal);
      try {
        const now = await (await send("GET", "/api/site", token, null, signal)).json();
        if (now.work.state === "none") return;
      } catch { /* it starts */ }
    }
  }
  const withConfiguration = (files, configuration) =>
    (files.some(({ name }) => name === CONFIGURATION) ? files : [textFile(CONFIGURATION, configuration), ...files]);
  const asked = (files) => {
    const brought = files.find(({ name }) => name === CONFIGURATION);
    const others = files.map(({ name }) => name).filter((name) => name !== CONFIGURATION);
    confirm(difference(current.configuration ?? "", new TextDecoder().decode(brought.bytes)), others, () => change("apply", files));
  };

  const stills = await kept().catch(() => []);
  const count = (folder) => stills.filter((still) => still.folder === folder).length;
  const calibrate = () => {
    const files = withConfiguration(forCalibration(stills), current.configuration ?? "");
    // Without stills for it the lens stays.
    if (count("lens") === 0 && current.camera) files.push(textFile("lens.toml", current.camera.text));
    asked(files);
  };
  const backup = () => {
    const files = withConfiguration([], current.configuration ?? "");
    if (current.camera) files.push(textFile(current.camera.name, current.camera.text));
    saveForStick(files, "beltgauge-site.tar");
  };
  const restore = h("input", { type: "file", accept: ".tar", id: "site-restore", onchange: async (event) => {
    const [file] = event.currentTarget.files;
    event.currentTarget.value = "";
    const files = file ? untar(await file.arrayBuffer()) : [];
    if (files.length === 0) tell("no_site");
    else asked(withConfiguration(files, current.configuration ?? ""));
  } });

  room.replaceChildren(
    h("section", { class: "card" }, h("h2", {}, t("site.configuration")), h("p", { class: "soft" }, t("site.configuration.hint")), text,
      h("div", { class: "bar" },
        button("check", true, () => change("check", [textFile(CONFIGURATION, text.value)])),
        button("apply", true, () => asked([textFile(CONFIGURATION, text.value)])),
        button("reset", true, () => { text.value = current.configuration ?? ""; }),
        button("back", current.can_go_back, () => confirm(null, [], () => change("back", null)))),
      words, h("h3", {}, t("site.report")), report),
    h("section", { class: "card" }, h("h2", {}, t("site.calibration")),
      h("p", {}, t("site.calibration.stills", { lens: count("lens"), belt: count("belt") })), h("p", { class: "soft" }, t("site.calibration.hint")),
      button("calibrate", count("belt") > 0, calibrate)),
    h("section", { class: "card" }, h("h2", {}, t("site.files")), h("p", { class: "soft" }, t("site.files.hint")),
      h("div", { class: "bar" }, button("backup", current.configuration !== null, backup), h("label", {}, t("site.restore"), " ", restore))),
    h("div", { class: "bar" }, button("sign_out", true, async () => {
      await send("DELETE", "/api/session", token, null, signal).catch(() => {});
      await enter();
    })));
}

// Ask once more, with what would change.
function confirm(lines, files, act) {
  const dialog = document.getElementById("dialog");
  const body = [];
  if (lines !== null) {
    const changed = lines.filter(([sign]) => sign !== " ");
    body.push(changed.length === 0 ? h("p", {}, t("site.same"))
      : h("pre", { class: "difference", tabindex: "0" }, lines.map(([sign, line]) => h("span", { class: { "+": "added", "-": "removed", " ": "kept" }[sign] }, `${sign} ${line}\n`))));
  }
  if (files.length > 0) body.push(h("p", {}, t("site.with", { files: files.length > 8 ? `${files.slice(0, 8).join(", ")} …` : files.join(", ") })));
  dialog.replaceChildren(
    h("h2", { id: "dialog-title" }, t(lines === null ? "site.back" : "site.apply")), ...body, h("p", { class: "soft" }, t("site.interrupts")),
    h("div", { class: "bar" },
      h("button", { type: "button", id: "site-confirm", onclick: () => { dialog.close(); act(); } }, t("site.confirm")),
      h("button", { type: "button", class: "end", autofocus: true, onclick: () => dialog.close() }, t("close"))));
  dialog.showModal();
}

// Lines that were added and removed, and those around them: by the longest common subsequence.
function difference(from, to) {
  const [a, b] = [from, to].map((text) => text.trimEnd().split("\n"));
  if (a.length > LINES_MAX || b.length > LINES_MAX) return b.map((line) => ["+", line]);
  const common = Array.from({ length: a.length + 1 }, () => new Uint16Array(b.length + 1));
  for (let i = a.length - 1; i >= 0; i -= 1) {
    for (let j = b.length - 1; j >= 0; j -= 1) common[i][j] = a[i] === b[j] ? common[i + 1][j + 1] + 1 : Math.max(common[i + 1][j], common[i][j + 1]);
  }
  const lines = [];
  for (let [i, j] = [0, 0]; i < a.length || j < b.length;) {
    if (i < a.length && j < b.length && a[i] === b[j]) lines.push([" ", a[i]]), i += 1, j += 1;
    else if (j === b.length || (i < a.length && common[i + 1][j] >= common[i][j + 1])) lines.push(["-", a[i]]), i += 1;
    else lines.push(["+", b[j]]), j += 1;
  }
  // Two lines of what stays around each change.
  const near = (k) => lines.slice(Math.max(k - 2, 0), k + 3).some(([sign]) => sign !== " ");
  return lines.filter((_, k) => near(k));
}
