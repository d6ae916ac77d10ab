// Setting the camera up: focus, exposure, and stills of the board to calibrate with.

import { ask, h, number, remember, remembered, svg, t } from "./common.js";
import { pull } from "./live.js";
import { BOARD, boardValue, forCalibration, forget, keep, kept, saveForStick } from "./stills.js";

const CORNERS = "#50ff78";
// A still of a lens: the board stood, within so many pixels from one picture to the next; and is
// elsewhere than in every other still, by this share of the picture's width.
const STANDS_PX = 2;
const ELSEWHERE = 0.06;
// A part of the picture is covered by so many corners; thirds along both sides.
const COVERED = 8;
const THIRDS = [0, 1, 2];
// Opposite sides of a board's image differ by this much when it is tilted.
const TILTED = 0.08;
// What `calibrate lens` and `calibrate belt` are content with.
const VIEWS = { lens: 12, tilted: 5, belt: 4 };
const VIEWS_MAX = 60;

export function setup(main, signal) {
  const canvas = h("canvas", { width: 16, height: 10, role: "img", "aria-label": t("setup.picture"), id: "setup" });
  const notice = h("p", { "aria-live": "polite" }, t("live.waiting"));
  const focus = focusAid();
  const exposure = exposureAid();
  const board = boardAid(signal);
  main.append(
    h("p", {}, t("setup.about")),
    h("div", { class: "columns" },
      h("div", { class: "stack" },
        h("section", { class: "card" }, h("h2", {}, t("setup.whole")), h("div", { class: "live" }, canvas, notice)), focus.card),
      h("div", { class: "stack" }, board.card, exposure.card)));
  const path = (shown) => {
    const query = [shown === null ? null : `after=${shown}`, board.query()].filter((part) => part !== null);
    return `/api/live/setup?${query.join("&")}`;
  };
  pull(path, signal, async (picture) => {
    notice.hidden = true;
    const { scene, bitmap } = picture;
    drawWhole(canvas, scene, bitmap);
    canvas.dataset.frame = scene.frame;
    focus.show(scene, bitmap);
    exposure.show(scene);
    await board.show(scene);
    bitmap.close();
  }, (error) => {
    notice.textContent = error?.message ?? t("live.none");
    notice.hidden = false;
  });
}

function drawWhole(canvas, { whole, board }, bitmap) {
  const [width, height] = whole.size_px;
  [canvas.width, canvas.height] = [width, height];
  const context = canvas.getContext("2d");
  context.drawImage(bitmap, 0, 0, width, height, 0, 0, width, height);
  context.strokeStyle = CORNERS;
  context.lineWidth = width / 450;
  const at = ([x, y]) => [x / whole.shrunk_by, y / whole.shrunk_by];
  for (const corner of board?.corners_px ?? []) {
    context.beginPath();
    context.arc(...at(corner), width / 200, 0, 2 * Math.PI);
    context.stroke();
  }
}

const PLACES = ["middle", "upper_left", "upper_right", "lower_left", "lower_right"];

// One to one pictures of five places, how blurred they are, and the best since the lens was touched.
function focusAid() {
  const best = PLACES.map(() => null);
  const places = PLACES.map((name) => ({
    canvas: h("canvas", { width: 200, height: 150, role: "img", "aria-label": t(`setup.place.${name}`) }),
    now: h("b"), best: h("span", { class: "soft" }),
  }));
  const anew = h("button", { type: "button", onclick: () => best.fill(null) }, t("setup.focus.anew"));
  const card = h("section", { class: "card" },
    h("h2", {}, t("setup.focus")), h("div", { class: "bar" }, h("span", { class: "soft" }, t("setup.focus.hint")), h("span", { class: "end" }, anew)),
    h("div", { class: "places" }, places.map((place, k) => h("figure", {}, place.canvas,
      h("figcaption", {}, t(`setup.place.${PLACES[k]}`), " ", place.now, " ", place.best)))));
  const show = (scene, bitmap) => scene.places.forEach((piece, k) => {
    const { canvas, now, best: held } = places[k];
    const [width, height] = piece.size_px;
    [canvas.width, canvas.height] = [width, height];
    canvas.getContext("2d").drawImage(bitmap, ...piece.at_px, width, height, 0, 0, width, height);
    if (piece.blur_px !== null) best[k] = Math.min(best[k] ?? Infinity, piece.blur_px);
    now.textContent = piece.blur_px === null ? t("setup.focus.none") : `${number(piece.blur_px, 2)} px`;
    held.textContent = best[k] === null ? "" : t("setup.focus.best", { blur: number(best[k], 2) });
  });
  return { card, show };
}

// How bright the picture is, and how far the belt moves meanwhile.
function exposureAid() {
  const bars = svg("svg", { class: "histogram", viewBox: "0 0 160 60", role: "img", "aria-label": t("setup.exposure.histogram") });
  const words = h("p");
  const motion = h("p");
  const card = h("section", { class: "card" }, h("h2", {}, t("setup.exposure")), bars, words, motion, h("p", { class: "soft" }, t("setup.exposure.hint")));
  const show = ({ histogram, white_share: white, black_share: black, motion_blur_px: blur }) => {
    const most = Math.max(...histogram, 1e-6);
    bars.replaceChildren(...histogram.map((share, i) => svg("rect", { x: 10 * i + 1, y: 60 - (58 * share) / most, width: 8, height: (58 * share) / most })));
    words.textContent = t("setup.exposure.shares", { white: number(100 * white, 1), black: number(100 * black, 1) });
    words.classList.toggle("warning", white > 0.01 || black > 0.2);
    motion.textContent = blur === null ? t("setup.exposure.no_time") : t("setup.exposure.motion", { blur: number(blur, 2) });
    motion.classList.toggle("warning", blur !== null && blur > 1);
  };
  return { card, show };
}

// The board: is it seen, what is missing still, and the stills that were kept.
function boardAid(signal) {
  const inputs = Object.fromEntries(Object.entries(BOARD).map(([name, [usual, min, max]]) => [name, h("input", {
    type: "number", min, max, step: Number.isInteger(usual) && name !== "square_mm" && name !== "thickness_mm" ? 1 : "any",
    value: remembered(`board.${name}`) ?? usual, onchange: (event) => remember(`board.${name}`, event.currentTarget.value),
  })]));
  const folder = h("select", {}, ["none", "lens", "belt"].map((name) => h("option", { value: name }, t(`setup.board.for_${name}`))));
  const words = h("p", { "aria-live": "polite", id: "board-words" });
  const next = h("p", { class: "soft", id: "board-next" });
  const map = svg("svg", { class: "coverage", viewBox: "0 0 90 60", role: "img", "aria-label": t("setup.board.map") });
  // The lens's are kept by themselves; where the belt has carried the board only a person knows.
  const take = h("button", { type: "button", id: "board-keep", onclick: () => { asked = true; } }, t("setup.board.keep"));
  const undo = h("button", { type: "button", disabled: true }, t("setup.board.undo"));
  const clear = h("button", { type: "button", disabled: true }, t("setup.board.clear"));
  const save = h("button", { type: "button", disabled: true, id: "board-save" }, t("setup.board.save"));
  const failed = h("p", { class: "warning", hidden: true });
  const card = h("section", { class: "card" },
    h("h2", {}, t("setup.board")),
    h("div", { class: "fields" },
      h("label", {}, t("setup.board.for"), folder),
      Object.entries(inputs).map(([name, input]) => h("label", {}, t(`setup.board.${name}`), input))),
    words, next, map, failed, h("div", { class: "bar" }, take, undo, clear, save),
    h("p", { class: "soft" }, t("setup.board.hint")));
  let stills = [];
  let before = null;
  let asked = false;

  const chosen = () => stills.filter((still) => still.folder === folder.value);
  async function renew() {
    try {
      stills = await kept();
      failed.hidden = true;
    } catch (error) {
      failed.textContent = t("setup.board.failed", { why: String(error?.message ?? error) });
      failed.hidden = false;
    }
    undo.disabled = chosen().length === 0;
    clear.disabled = save.disabled = stills.length === 0;
    const { words: hint, cells } = missing(chosen(), folder.value);
    next.textContent = hint;
    map.replaceChildren(...cells.map((corners, i) => svg("rect", {
      x: 30 * (i % 3) + 1, y: 20 * Math.floor(i / 3) + 1, width: 28, height: 18, class: corners >= COVERED ? "covered" : "empty" })));
    map.toggleAttribute("hidden", folder.value !== "lens");
    take.hidden = folder.value !== "belt";
    card.dataset.stills = chosen().length;
  }
  folder.addEventListener("change", () => {
    [before, asked] = [null, false];
    renew();
  });
  undo.addEventListener("click", async () => {
    const last = chosen().at(-1);
    if (last) await forget(last.key);
    await renew();
  });
  clear.addEventListener("click", async () => {
    for (const still of stills) await forget(still.key);
    await renew();
  });
  save.addEventListener("click", () => saveForStick(forCalibration(stills), "beltgauge-stills.tar"));
  renew();

  async function show({ frame, board, size_px: size }) {
    if (folder.value === "none") {
      words.textContent = t("setup.board.none");
      return;
    }
    let verdict = judged(board, before, chosen(), folder.value, size);
    if (verdict === "good" && folder.value === "belt" && !asked) verdict = "ready";
    before = board?.outline_px ?? null;
    words.textContent = t(`setup.board.${verdict}`, { columns: board?.size?.[0] ?? "", rows: board?.size?.[1] ?? "" });
    asked = false;
    if (verdict !== "good") return;
    try {
      const answer = await ask(`/api/still/${frame}`, signal);
      const bytes = new Uint8Array(await answer.arrayBuffer());
      await keep({ folder: folder.value, size, corners: board.corners_px, outline: board.outline_px, bytes });
    } catch {
      // The next picture is as good.
      return;
    }
    await renew();
  }
  const query = () => (folder.value === "none" ? null : `columns=${Math.round(boardValue("columns"))}&rows=${Math.round(boardValue("rows"))}`);
  return { card, show, query };
}

// Whether a still of this board is worth keeping: good, or why not.
function judged(board, before, stills, folder, [width]) {
  if (!board || board.found !== "found") return board?.found ?? "no_grid";
  const outline = board.outline_px;
  if (outline.length < 4) return "corner_hidden";
  if (stills.length >= VIEWS_MAX) return "full";
  const away = (other) => outline.reduce((sum, [x, y], k) => sum + Math.hypot(x - other[k][0], y - other[k][1]), 0) / outline.length;
  if (stills.some((still) => away(still.outline) < ELSEWHERE * width)) return "known";
  if (folder === "lens" && (before?.length !== 4 || away(before) > STANDS_PX)) return "moves";
  return "good";
}

const isTilted = ([a, b, c, d]) => {
  const side = ([x0, y0], [x1, y1]) => Math.hypot(x1 - x0, y1 - y0);
  return [[side(a, b), side(d, c)], [side(b, c), side(a, d)]].some(([one, other]) => Math.abs(Math.log(one / other)) > TILTED);
};

// What to show next, and how many corners each part of the picture has had.
function missing(stills, folder) {
  const cells = THIRDS.flatMap(() => THIRDS.map(() => 0));
  for (const { size: [width, height], corners } of stills) {
    const third = (at, side) => Math.min(Math.floor((3 * at) / side), 2);
    for (const [x, y] of corners) cells[3 * third(y, height) + third(x, width)] += 1;
  }
  const views = stills.length;
  if (folder === "none") return { words: "", cells };
  if (folder === "belt") {
    return { words: t(views < VIEWS.belt ? "setup.board.belt_more" : "setup.board.belt_enough", { views }), cells };
  }
  const tilted = stills.filter(({ outline }) => isTilted(outline)).length;
  const empty = cells.findIndex((corners) => corners < COVERED);
  const words = empty >= 0 ? t("setup.board.more_at", { views, place: t(`setup.part.${empty}`) })
    : tilted < VIEWS.tilted ? t("setup.board.more_tilted", { views, tilted })
    : views < VIEWS.lens ? t("setup.board.more", { views, most: VIEWS.lens })
    : t("setup.board.enough", { views });
  return { words, cells };
}
