// Parcels: the last ones from the machine's memory, older ones from the archive.

import { askJson, every, h, has, number, svg, t, time } from "./common.js";

const KEPT = 200;
const FILTERS = {
  all: () => true,
  usable: (parcel) => parcel.may_be_used,
  doubtful: (parcel) => !parcel.may_be_used && parcel.not_measured === null,
  not_measured: (parcel) => parcel.not_measured !== null,
};

export function parcels(main, signal) {
  main.append(parcelTable(signal, { title: t("parcels.title"), most: KEPT, filters: true }), archived(signal));
}

export function parcelTable(signal, { title, most, filters }) {
  const body = h("tbody");
  const empty = h("p", { class: "soft" }, t("parcels.none"));
  let [known, since, run, filter] = [[], 0, null, "all"];
  const show = () => {
    const shown = known.filter(FILTERS[filter]).slice(-most).reverse();
    body.replaceChildren(...shown.map((parcel) => row(parcel, `${parcel.n}`)));
    empty.hidden = shown.length > 0;
  };
  const choice = h("select", { "aria-label": t("parcels.filter"), onchange: (event) => { filter = event.target.value; show(); } },
    Object.keys(FILTERS).map((name) => h("option", { value: name }, t(`filter.${name}`))));
  every(1000, signal, async () => {
    const list = await askJson(`/api/parcels?since=${since}&limit=${filters ? KEPT : most}`, signal);
    // The machine was started anew: its numbers begin again.
    if (run !== null && run !== list.run) [known, since] = [[], 0];
    else if (list.items.length > 0 || run === null) {
      known = [...known, ...list.items].slice(-KEPT);
      since = list.next;
      show();
    }
    run = list.run;
  });
  return h("section", { class: "card" },
    h("div", { class: "bar" }, h("h2", {}, title), filters ? h("span", { class: "end" }, h("a", { href: "/api/parcels.csv", download: "parcels.csv" }, t("parcels.csv")), " ", choice) : null,
      filters ? null : h("a", { class: "end", href: "#parcels" }, t("parcels.all"))),
    table(body), empty);
}

function archived(signal) {
  const body = h("tbody");
  const notice = h("p", { class: "soft" }, t("archive.hint"));
  const missing = h("div", { class: "warning", role: "status" });
  const [told, warn] = [new Set(), (place) => {
    if (!told.has(place)) missing.append(h("p", {}, t("archive.unread", { place })));
    told.add(place);
  }];
  let before = null;
  const more = h("button", { type: "button", onclick: async () => {
    try {
      const list = await askJson(`/api/archive?limit=100${before === null ? "" : `&before=${before}`}`, signal);
      for (const { entry, kind, what } of list.entries) {
        if (kind === "parcel") body.append(row(what, `archive/${entry}`));
      }
      list.unread.forEach(warn);
      before = list.before;
      notice.textContent = before === null ? t("archive.end") : "";
      more.disabled = before === null;
    } catch (error) {
      notice.textContent = `${t("archive.unreadable")} ${error.message}`;
    }
  } }, t("archive.more"));
  return h("section", { class: "card" }, h("h2", {}, t("archive.title")), table(body), missing, notice, more);
}

function table(body) {
  const heads = ["picture", "seq", "time", "length", "width", "height", "verdict", "doubts"];
  const numeric = ["length", "width", "height"];
  return h("div", { class: "scroll" }, h("table", {},
    h("thead", {}, h("tr", {}, heads.map((name) => h("th", { scope: "col", class: numeric.includes(name) ? "number" : null }, t(`parcel.${name}`))))),
    body));
}

// A parcel's place: `N` since start, `archive/ENTRY` on the disk.
const picturePath = (place) => (place.startsWith("archive/") ? `/api/${place}/picture` : `/api/parcels/${place}/picture`);

// One parcel, by an address that can be passed on: that of the archive holds over restarts.
export async function parcel(main, signal, where) {
  const place = where.join("/");
  const [, archive, number] = /^(archive\/)?(\d{1,15})$/.exec(place) ?? [];
  const card = h("section", { class: "card" }, h("p", { class: "soft" }, t("parcel.waiting")));
  main.append(h("p", {}, h("a", { href: "#parcels" }, t("parcels.all"))), card);
  let found = null;
  try {
    if (archive) {
      const { entries } = await askJson(`/api/archive?before=${Number(number) + 1}&limit=1`, signal);
      found = entries.find((one) => one.entry === Number(number) && one.kind === "parcel")?.what;
    } else if (number) {
      const { items } = await askJson(`/api/parcels?since=${Math.max(Number(number) - 1, 0)}`, signal);
      found = items.find((one) => one.n === Number(number));
    }
  } catch (error) {
    if (signal.aborted) return;
    card.replaceChildren(h("p", {}, `${t("archive.unreadable")} ${error.message}`));
    return;
  }
  if (signal.aborted) return;
  card.replaceChildren(...(found ? details(found, place) : [h("p", {}, t("parcel.unknown"))]));
}

function row(parcel, place) {
  const size = (mm, sigma) => h("td", { class: "number" }, parcel.not_measured !== null ? "–" : [number(mm), h("span", { class: "sigma" }, ` ± ${number(sigma, 2)}`)]);
  return h("tr", {},
    h("td", {}, parcel.picture ? picture(parcel, picturePath(place), false) : ""),
    h("td", {}, h("button", { type: "button", class: "link", title: t("parcel.open"), onclick: () => open(parcel, place) }, `${parcel.seq}`)),
    h("td", {}, time(parcel.utc_ms)),
    size(parcel.length_mm, parcel.sigma_length_mm),
    size(parcel.width_mm, parcel.sigma_width_mm),
    size(parcel.height_mm, parcel.sigma_height_mm),
    h("td", {}, verdict(parcel)),
    h("td", { class: "flags" }, doubts(parcel)));
}

function verdict(parcel) {
  if (parcel.may_be_used) return h("span", { class: "chip good" }, t("verdict.usable"));
  if (parcel.not_measured !== null) return h("span", { class: "chip bad" }, t("verdict.not_measured"));
  return h("span", { class: "chip doubt" }, t("verdict.doubtful"));
}

function doubts(parcel) {
  const words = parcel.flags.map((flag) => t(`flag.${flag}`));
  if (parcel.not_measured !== null) words.unshift(t(`not_measured.${parcel.not_measured}`));
  if (parcel.shape === "irregular" && parcel.not_measured === null) words.push(t("shape.irregular"));
  // No flag, and yet not to be used: that is the sigma.
  if (words.length === 0 && !parcel.may_be_used) words.push(t("parcel.sigma"));
  return words.join("; ");
}

function picture(parcel, path, large) {
  const { size_px: [width, height], cuboid_px: corners } = parcel.picture;
  const lines = [];
  if (corners) {
    const path = (points, closed) => `M${points.map(([x, y]) => `${x} ${y}`).join("L")}${closed ? "Z" : ""}`;
    const [base, top] = [corners.slice(0, 4), corners.slice(4)];
    lines.push(svg("path", { class: "base", d: path(base, true) }));
    for (let k = 0; k < 4; k += 1) lines.push(svg("path", { class: "side", d: path([base[k], top[k]], false) }));
    lines.push(svg("path", { class: "top", d: path(top, true) }));
  }
  const frame = h("span", { class: "thumb" },
    h("img", { src: path, alt: t("parcel.picture_of", { seq: parcel.seq }), width, height, loading: "lazy" }),
    svg("svg", { viewBox: `0 0 ${width} ${height}`, preserveAspectRatio: "none", "aria-hidden": "true" }, ...lines));
  const [widest, highest] = large ? [640, 0.45 * window.innerHeight] : [104, 72];
  frame.style.width = `${Math.min(widest, (highest * width) / height)}px`;
  return frame;
}

function open(parcel, place) {
  const dialog = document.getElementById("dialog");
  dialog.replaceChildren(
    h("div", { class: "bar" }, h("a", { href: `#parcel/${place}` }, t("parcel.page")),
      h("button", { type: "button", class: "end", onclick: () => dialog.close(), autofocus: true }, t("close"))),
    ...details(parcel, place));
  dialog.showModal();
}

// Why there is no picture; entries of an earlier version do not say.
function noPicture({ no_picture: why }) {
  const key = `no_picture.${why}`;
  return has(key) ? t(key) : t("parcel.no_picture");
}

function details(parcel, place) {
  const figure = (key, value, unit, digits) => h("div", {}, h("dt", {}, t(`parcel.${key}`)), h("dd", {}, `${number(value, digits)} ${unit}`));
  const sized = (key) => h("div", {}, h("dt", {}, t(`parcel.${key}`)), h("dd", {}, `${number(parcel[`${key}_mm`])} ± ${number(parcel[`sigma_${key}_mm`], 2)} mm`));
  return [
    h("div", { class: "bar" }, h("h2", { id: "dialog-title" }, t("parcel.title", { seq: parcel.seq })), verdict(parcel)),
    parcel.picture ? h("p", {}, picture(parcel, picturePath(place), true)) : h("p", { class: "soft" }, noPicture(parcel)),
    h("p", {}, doubts(parcel) || t("parcel.no_doubt")),
    h("dl", { class: "figures" },
      ...(parcel.not_measured === null ? ["length", "width", "height"].map(sized) : []),
      figure("yaw", parcel.yaw_deg, "°", 1), figure("x", parcel.x_mm, "mm", 1), figure("y", parcel.y_mm, "mm", 1),
      figure("speed", parcel.belt_speed_mm_per_s, "mm/s", 1), figure("travel", parcel.belt_travel_mm, "mm", 0),
      figure("frame", parcel.frame, "", 0), figure("t", parcel.t_s, "s", 2),
      h("div", {}, h("dt", {}, t("parcel.time")), h("dd", {}, time(parcel.utc_ms)))),
  ];
}
