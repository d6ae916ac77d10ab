// The live picture with zone, grid, tracks and cuboids of the same frame.

import { ask, h, pause, remember, remembered, t, visible } from "./common.js";

const COLOURS = { zone: "#5ad0ff", grid: "rgba(255,255,255,0.22)", label: "rgba(255,255,255,0.75)", candidate: "#c8c8c8", base: "#ffaa28", side: "#5ad0ff", top: "#50ff78", told: "#9aa7ff" };

export function live(signal) {
  const options = { view: remembered("view") === "raw" ? "raw" : "belt", grid: true, parcels: true, bright: true };
  for (const name of ["grid", "parcels", "bright"]) options[name] = remembered(name) !== "no";
  const canvas = h("canvas", { width: 16, height: 10, role: "img", "aria-label": t("live.picture"), id: "live" });
  const notice = h("p", { "aria-live": "polite" }, t("live.waiting"));
  const figure = h("span", { class: "end soft", id: "live-figure" });
  let newest = null;

  const choice = (view) => h("button", { type: "button", "aria-pressed": String(options.view === view), onclick: () => {
    options.view = view;
    remember("view", view);
    newest = null;
    for (const [name, button] of Object.entries(choices)) button.setAttribute("aria-pressed", String(name === view));
    restart();
  } }, t(`live.${view}`));
  const choices = {};
  for (const view of ["belt", "raw"]) choices[view] = choice(view);
  const toggle = (name) => h("button", { type: "button", "aria-pressed": String(options[name]), onclick: (event) => {
    options[name] = !options[name];
    remember(name, options[name] ? "yes" : "no");
    event.currentTarget.setAttribute("aria-pressed", String(options[name]));
    if (newest) draw(canvas, newest, options);
  } }, t(`live.${name}`));

  let round = new AbortController();
  function restart() {
    round.abort();
    round = new AbortController();
    signal.addEventListener("abort", () => round.abort(), { once: true });
    follow(round.signal);
  }

  const follow = (over) => pull((shown) => `/api/live/${options.view}${shown === null ? "" : `?after=${shown}`}`, over, (picture) => {
    newest?.bitmap.close();
    newest = picture;
    const { scene } = picture;
    draw(canvas, picture, options);
    notice.hidden = true;
    figure.textContent = t("live.figure", { frame: scene.frame, time: scene.t_s.toFixed(2), parcels: scene.parcels.filter((p) => p.phase === "riding").length });
    canvas.dataset.frame = scene.frame;
  }, () => {
    notice.textContent = t("live.none");
    notice.hidden = false;
  });
  restart();

  return h("section", { class: "card" },
    h("h2", {}, t("live.title")),
    h("div", { class: "bar" }, choices.belt, choices.raw, toggle("grid"), toggle("parcels"), toggle("bright"), figure),
    h("div", { class: "live" }, canvas, notice),
    h("div", { class: "legend" }, ["zone", "top", "base", "candidate"].map((name) => h("span", {}, h("i", { class: name }), t(`live.legend.${name}`)))));
}

// Ask for one picture after the other, each as soon as the one before is shown; not while nobody sees
// them. path: of the next one, by the frame that was shown last.
export async function pull(path, over, show, miss) {
  let shown = null;
  while (!over.aborted) {
    await visible(over);
    if (over.aborted) return;
    try {
      const answer = await ask(path(shown), over);
      if (answer.status === 204) {
        miss();
        await pause(300, over);
        continue;
      }
      const picture = await decoded(new Uint8Array(await answer.arrayBuffer()));
      if (over.aborted) return;
      await show(picture);
      shown = picture.scene.frame;
    } catch (error) {
      if (over.aborted) return;
      miss(error);
      await pause(1000, over);
    }
  }
}

// A line of JSON, then the JPEG.
async function decoded(bytes) {
  const end = bytes.indexOf(10);
  const scene = JSON.parse(new TextDecoder().decode(bytes.subarray(0, end)));
  const bitmap = await createImageBitmap(new Blob([bytes.subarray(end + 1)], { type: "image/jpeg" }));
  return { scene, bitmap };
}

function draw(canvas, { scene, bitmap }, options) {
  const [width, height] = scene.size_px;
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
  const context = canvas.getContext("2d");
  context.filter = options.bright ? "brightness(2.2)" : "none";
  context.drawImage(bitmap, 0, 0);
  context.filter = "none";
  const unit = width / 900;
  const line = (points, colour, thick, closed) => {
    if (points.length < 2) return;
    context.beginPath();
    points.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
    if (closed) context.closePath();
    context.strokeStyle = colour;
    context.lineWidth = thick * unit;
    context.stroke();
  };
  context.font = `${Math.round(11 * unit)}px system-ui, sans-serif`;
  if (options.grid) {
    for (const [axis, mm, points] of scene.grid_px) {
      line(points, COLOURS.grid, mm === 0 ? 2 : 1, false);
      const [x, y] = points[0] ?? [0, 0];
      context.fillStyle = COLOURS.label;
      context.textAlign = axis === "x" ? "center" : "left";
      context.fillText(`${mm}`, axis === "x" ? x : x + 4 * unit, axis === "x" ? y - 4 * unit : y - 3 * unit);
    }
    line(scene.zone_px, COLOURS.zone, 2, true);
    arrow(context, scene.travel_px, unit);
  }
  if (!options.parcels) return;
  for (const parcel of scene.parcels) {
    const corners = parcel.cuboid_px;
    if (!corners) {
      line(parcel.bounds_px, COLOURS.candidate, 1.5, true);
      continue;
    }
    const told = parcel.phase === "told";
    const [base, top] = [corners.slice(0, 4), corners.slice(4)];
    line(base, told ? COLOURS.told : COLOURS.base, 1.5, true);
    for (let k = 0; k < 4; k += 1) line([base[k], top[k]], told ? COLOURS.told : COLOURS.side, 1, false);
    line(top, told ? COLOURS.told : COLOURS.top, 2, true);
  }
}

function arrow(context, [[x0, y0], [x1, y1]], unit) {
  const [dx, dy] = [x1 - x0, y1 - y0];
  const length = Math.hypot(dx, dy) || 1;
  const [ux, uy] = [dx / length, dy / length];
  const wing = 8 * unit;
  context.beginPath();
  context.moveTo(x0, y0);
  context.lineTo(x1, y1);
  context.moveTo(x1 - wing * (ux - uy * 0.6), y1 - wing * (uy + ux * 0.6));
  context.lineTo(x1, y1);
  context.lineTo(x1 - wing * (ux + uy * 0.6), y1 - wing * (uy - ux * 0.6));
  context.strokeStyle = COLOURS.zone;
  context.lineWidth = 2 * unit;
  context.stroke();
}
