// The first page: live picture, lamps in words, the last parcels, figures.

import { bytes, count, h, number, t } from "./common.js";
import { live } from "./live.js";
import { parcelTable } from "./parcels.js";

// The code of the reason "the archive".
const OF_ARCHIVE = 20;

export function overview(main, signal) {
  const reasons = h("ul", { class: "reasons" });
  const figures = h("dl", { class: "figures" });
  main.append(
    h("div", { class: "columns" }, live(signal),
      h("div", { class: "stack" },
        h("section", { class: "card", "aria-live": "polite" }, h("h2", {}, t("overview.state")), reasons),
        h("section", { class: "card" }, h("h2", {}, t("overview.figures")), figures))),
    parcelTable(signal, { title: t("overview.parcels"), most: 8, filters: false }));
  document.addEventListener("state", ({ detail }) => {
    const words = explained(detail);
    // A screen reader reads it when it changes, not every second.
    if (reasons.dataset.shown !== words.key) {
      reasons.dataset.shown = words.key;
      reasons.replaceChildren(...words.items);
    }
    figures.replaceChildren(...figuresOf(detail));
  }, { signal });
}

// What is wrong with the archive, in words.
function archiveDetails({ fault, damaged, entries_lost: lost }) {
  const details = [];
  if (fault !== null) details.push(t("archive.fault", { fault }));
  if (damaged !== null) details.push(t("archive.damaged", { name: damaged }));
  if (lost > 0) details.push(t("archive.lost", { lost: count(lost) }));
  return details;
}

function explained(state) {
  const details = archiveDetails(state.archive);
  const items = [];
  const told = new Set();
  for (const lamp of [...state.lamps].reverse()) {
    for (const code of lamp.reasons.filter((code) => !told.has(code))) {
      told.add(code);
      items.push(h("li", { class: lamp.on ? lamp.name : "" }, h("b", {}, t(`reason.${code}`)), h("span", {}, [t(`remedy.${code}`), ...(code === OF_ARCHIVE ? details : [])].join(" "))));
    }
  }
  if (items.length === 0) items.push(h("li", { class: "running" }, h("b", {}, t("reason.0")), h("span", {}, t("remedy.0"))));
  return { key: `${[...told].join()} ${details.join()} ${document.documentElement.lang}`, items };
}

function figuresOf(state) {
  const { camera, belt, counts, archive } = state;
  const speed = belt.by_encoder ? "figure.by_encoder" : belt.measured ? "figure.by_texture" : "figure.assumed";
  const figures = [
    ["figure.speed", `${number(belt.speed_mm_per_s)} mm/s (${t(speed)})`],
    ["figure.parcels", count(counts.parcels)],
    ["figure.usable", count(counts.parcels_usable)],
    ["figure.unmeasured", count(counts.parcels_unmeasured)],
    ["figure.frames", count(camera.frames)],
    ["figure.dropped", `${count(camera.frames_dropped)} / ${count(camera.frames_lost)} / ${count(camera.frames_torn)}`],
    ["figure.slowest", `${number(camera.frame_time_max_ms)} ms`],
    ["figure.camera", `${camera.size_px.join(" × ")} px`],
    ["figure.losses", count(camera.losses)],
    ["figure.watch", camera.watch < 2 ? t(`figure.watch_${camera.watch}`) : `${number(camera.moved_px, 2)} px = ${number(camera.moved_error_mm, 2)} mm${t(`figure.watch_${camera.watch}`)}`],
    ["figure.blur", camera.blur_px === null ? t("figure.not_known") : `${number(camera.blur_px, 2)} px`],
    ["figure.light", camera.light_region === 0 ? t("figure.watch_0") : t("figure.light_part", { change: number(100 * camera.light_change, 0), row: Math.ceil(camera.light_region / 4), column: (camera.light_region - 1) % 4 + 1 })],
  ];
  if (belt.encoder_ratio !== null) figures.push(["figure.encoder_ratio", number(belt.encoder_ratio, 4)]);
  figures.push(["figure.archive", archive.enabled ? t("figure.archive_used", { used: bytes(archive.bytes), most: bytes(archive.bytes_max) }) : t("figure.archive_none")]);
  if (archive.entries_lost > 0) figures.push(["figure.archive_lost", count(archive.entries_lost)]);
  return figures.map(([key, value]) => h("div", {}, h("dt", {}, t(key)), h("dd", {}, value)));
}
