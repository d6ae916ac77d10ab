// Charts of the last hours, drawn by uPlot.

import { askJson, currentLanguage, every, h, number, remember, remembered, t } from "./common.js";

// Seconds that are shown, and seconds that one place of a line sums up.
const RANGES = { minutes: [600, 10], hour: [3600, 60], shift: [28800, 300] };
const KEPT = 2880;
const percent = (part, whole) => (whole > 0 ? (100 * part) / whole : null);
// What each chart shows of what happened meanwhile: a line each, and its digits.
const CHARTS = {
  rate: { digits: 0, lines: { parcels: (sum) => (3600 * sum.parcels) / sum.span_s } },
  refused: { digits: 1, lines: { refused: (sum) => percent(sum.refused, sum.parcels), unmeasured: (sum) => percent(sum.unmeasured, sum.parcels) } },
  sigma: { digits: 2, lines: { length: (sum) => sum.mean("length"), width: (sum) => sum.mean("width"), height: (sum) => sum.mean("height") } },
  speed: { digits: 1, lines: { speed: (sum) => sum.mean("speed") } },
  blur: { digits: 2, lines: { blur: (sum) => sum.mean("blur") } },
  missing: { digits: 1, lines: { missing: (sum) => (60 * sum.missing) / sum.span_s } },
};

export function trend(main, signal) {
  let [points, since, run] = [[], 0, null];
  let range = Object.hasOwn(RANGES, remembered("range")) ? remembered("range") : "minutes";
  const empty = h("p", { class: "soft" }, t("trend.none"));
  const charts = Object.entries(CHARTS).map(([name, what]) => chart(name, what, signal));
  const show = () => {
    const [shown_s, step_s] = RANGES[range];
    const last_s = (points.at(-1)?.utc_ms ?? Date.now()) / 1000;
    const sums = summed(points.filter((point) => point.utc_ms / 1000 > last_s - shown_s), step_s);
    charts.forEach(({ draw }) => draw(sums, [last_s - shown_s, last_s]));
    empty.hidden = points.length > 0;
  };
  const buttons = Object.keys(RANGES).map((name) => h("button", { type: "button", "aria-pressed": String(name === range), onclick: () => {
    range = name;
    remember("range", name);
    buttons.forEach((button, i) => button.setAttribute("aria-pressed", String(Object.keys(RANGES)[i] === name)));
    show();
  } }, t(`trend.range.${name}`)));
  main.append(h("div", { class: "bar" }, buttons, empty), h("div", { class: "charts" }, charts.map(({ card }) => card)));
  document.addEventListener("theme", show, { signal });
  every(2000, signal, async () => {
    // As many questions as it takes to be up to date.
    for (;;) {
      const list = await askJson(`/api/trend?since=${since}`, signal);
      // The machine was started anew: its numbers begin again.
      if (run !== null && run !== list.run) [points, since] = [[], 0];
      else if (list.items.length > 0) {
        points = [...points, ...list.items].slice(-KEPT);
        since = list.next;
      } else if (run !== null) break;
      run = list.run;
      show();
    }
  });
}

// Points, those of each step summed up to one.
function summed(points, step_s) {
  const sums = [];
  for (const point of points) {
    const place = Math.floor(point.utc_ms / 1000 / step_s);
    // The clock may be set back: lines go forward.
    if (sums.length === 0 || place > sums.at(-1).place) sums.push(new Sum(place, place * step_s));
    sums.at(-1).add(point);
  }
  return sums;
}

class Sum {
  constructor(place, time_s) {
    Object.assign(this, { place, time_s, span_s: 0, parcels: 0, refused: 0, unmeasured: 0, missing: 0, totals: {} });
  }

  add(point) {
    this.span_s += point.span_s;
    this.parcels += point.parcels;
    this.refused += point.refused;
    this.unmeasured += point.unmeasured;
    this.missing += point.frames_missing;
    const measured = point.parcels - point.unmeasured;
    ["length", "width", "height"].forEach((side, i) => this.weigh(side, point.sigma_mm?.[i], measured));
    this.weigh("speed", point.belt_speed_mm_per_s, point.span_s);
    this.weigh("blur", point.blur_px, point.span_s);
  }

  weigh(name, value, weight) {
    if (value === null || value === undefined) return;
    const [total, weights] = this.totals[name] ?? [0, 0];
    this.totals[name] = [total + value * weight, weights + weight];
  }

  mean(name) {
    const [total, weights] = this.totals[name] ?? [0, 0];
    return weights > 0 ? total / weights : null;
  }
}

function chart(name, { digits, lines }, signal) {
  const keys = Object.keys(lines);
  const place = h("div", { class: "chart", role: "img" });
  const title = t(`trend.${name}`);
  const card = h("section", { class: "card" }, h("h2", {}, title), place);
  let [plot, shown_s] = [null, [0, 1]];
  // A colour of the theme that is shown, as a canvas takes it.
  const probe = h("span", { hidden: true });
  card.append(probe);
  const colour = (of) => () => {
    probe.className = of;
    return getComputedStyle(probe).color;
  };
  const clock = (s) => new Date(s * 1000).toLocaleTimeString(currentLanguage(), { hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23" });
  // The value under the cursor, or the last one.
  const told = (words) => ({ data }, value, line, at) => {
    const shown = at === null ? data[line].at(-1) : value;
    return shown === null || shown === undefined ? "–" : words(shown);
  };
  const axis = { stroke: colour("soft"), grid: { stroke: colour("line"), width: 1 }, ticks: { stroke: colour("line"), width: 1 } };
  const settings = () => ({
    width: place.clientWidth, height: 190,
    cursor: { sync: { key: "trend" }, drag: { setScale: false } },
    scales: { x: { range: () => shown_s }, y: { range: (_, low, high) => reach(low, high, 5 / 10 ** digits) } },
    axes: [
      { ...axis, values: (_, ticks) => ticks.map((s) => clock(s).slice(0, 5)), space: 60 },
      { ...axis, values: (_, ticks) => ticks.map((value) => number(value, Number.isInteger(value) ? 0 : digits)), size: 60 },
    ],
    series: [
      { label: t("trend.time"), value: told(clock) },
      ...keys.map((key, i) => ({ label: t(`trend.line.${key}`), stroke: colour(`line-${i}`), width: 2, points: { size: 5 },
        value: told((value) => number(value, digits)) })),
    ],
  });
  const draw = (sums, range_s) => {
    shown_s = range_s;
    const data = [sums.map((sum) => sum.time_s), ...keys.map((key) => sums.map(lines[key]))];
    plot ??= new uPlot(settings(), data, place);
    plot.setData(data);
    const last = keys.map((key, i) => `${t(`trend.line.${key}`)} ${number(data[i + 1].at(-1), digits)}`).join(", ");
    place.setAttribute("aria-label", `${title}: ${last}`);
  };
  const resized = new ResizeObserver(() => plot?.setSize({ width: place.clientWidth, height: 190 }));
  resized.observe(place);
  signal.addEventListener("abort", () => { resized.disconnect(); plot?.destroy(); }, { once: true });
  return { card, draw };
}

// From nothing, or around a value that hardly changes; never of less height than the least.
function reach(low, high, least) {
  if (low === null || high === null) return [0, least];
  const room = Math.max(0.1 * (high - low), 0.005 * Math.abs(high), least);
  return [low >= 0 && low - room < 0.5 * high ? 0 : low - room, high + room];
}
