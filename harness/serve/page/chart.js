"use strict";
// Charts by uPlot: dragging zooms, the wheel zooms, Shift and dragging pans, a click on the legend hides a series.

/** Colors of series, which can be told apart on light and dark ground. */
const COLORS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a6d00", "#7a5cc4"];

const ink = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/**
 * A chart of series over x.
 *
 * The content has `title`, `x` (`label` and sorted `values`), `y` (`label`, `logarithmic`), and `series` (`name`, `values`
 * with null where there is none, `color` a number, `dashed`, `points`). `update` draws new content. A zoom is kept until the
 * chart is reset by a double click, Escape, or 0.
 */
class Chart {
  constructor(place, content) {
    this.place = element("div", { class: "place", tabindex: "0", role: "group" });
    this.tooltip = element("div", { class: "tooltip", role: "status", hidden: "" });
    const hint = "Drag to zoom, Shift and drag to pan, double-click to reset. Keys: arrows, +, −, 0.";
    this.box = element("div", { class: "chart" }, element("h3", {}, content.title), this.place, element("p", { class: "hint" }, hint));
    place.append(this.box);
    this.place.addEventListener("keydown", (event) => this.key(event));
    this.place.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    this.place.addEventListener("pointerdown", (event) => this.startPan(event), { capture: true });
    new ResizeObserver(() => this.plot?.setSize(this.size())).observe(this.box);
    this.update(content);
  }

  size() {
    const width = Math.max(240, this.box.clientWidth - 18);
    return { width, height: Math.round(Math.max(200, Math.min(340, width * 0.55))) };
  }

  update(content) {
    const kept = this.zoomed ? { ...this.plot.scales.x } : null;
    const hidden = new Set((this.plot?.series ?? []).filter((series) => series.show === false).map((series) => series.label));
    this.content = content;
    const data = [content.x.values, ...content.series.map((series) => series.values)];
    this.place.dataset.last = content.x.values.at(-1) ?? "";
    this.place.setAttribute("aria-label", `${content.title}: ${content.y.label} over ${content.x.label}`);
    this.plot?.destroy();
    const axis = { stroke: ink("--ink"), grid: { stroke: ink("--line"), width: 1 }, ticks: { stroke: ink("--line"), width: 1 } };
    const series = content.series.map((series) => ({
      label: series.name,
      stroke: COLORS[series.color % COLORS.length],
      width: 1.6,
      dash: series.dashed ? [6, 4] : undefined,
      points: { show: series.points || content.x.values.length < 40, size: 5 },
      spanGaps: true,
      show: !hidden.has(series.name),
      value: (_, value) => shown(value),
    }));
    const positive = content.series.every((series) => series.values.every((value) => value === null || value > 0));
    this.plot = new uPlot({
      ...this.size(),
      scales: { x: { time: false }, y: { distr: content.y.logarithmic && positive ? 3 : 1 } },
      axes: [{ ...axis, label: content.x.label, labelSize: 22 }, { ...axis, label: content.y.label, labelSize: 22, size: 62 }],
      series: [{ label: content.x.label, value: (_, value) => shown(value) }, ...series],
      cursor: { drag: { x: true, y: false, dist: 5 } },
      legend: { live: false, markers: { dash: (plot, index) => (plot.series[index].dash ? "dashed" : "solid") } },
      hooks: { setCursor: [() => this.tell()], setScale: [(plot, key) => key === "x" && this.noticeZoom(plot)] },
    }, data, this.place);
    this.plot.over.append(this.tooltip);
    this.plot.over.addEventListener("dblclick", () => this.reset());
    if (kept) this.plot.setScale("x", kept);
  }

  noticeZoom(plot) {
    const all = plot.data[0];
    const { min, max } = plot.scales.x;
    this.zoomed = all.length > 1 && (min > all[0] || max < all[all.length - 1]);
  }

  /** Shows the values at the cursor: those of the series nearest to it first. */
  tell() {
    const { idx, left, top } = this.plot.cursor;
    this.tooltip.hidden = idx === null || idx === undefined || left < 0;
    if (this.tooltip.hidden) return;
    const near = this.plot.series.slice(1).map((series, index) => ({ series, value: this.plot.data[index + 1][idx] }))
      .filter(({ series, value }) => series.show && value !== null && value !== undefined)
      .map((one) => ({ ...one, distance: Math.abs(this.plot.valToPos(one.value, "y") - top) }))
      .sort((a, b) => a.distance - b.distance).slice(0, 6);
    const lines = near.map(({ series, value }) => element("div", {}, `${series.label}: ${shown(value)}`));
    this.tooltip.replaceChildren(element("b", {}, `${this.content.x.label} ${shown(this.plot.data[0][idx])}`), ...lines);
    const [width, height] = [this.tooltip.offsetWidth, this.tooltip.offsetHeight];
    const room = this.plot.over.clientWidth;
    this.tooltip.style.left = `${left + 14 + width > room ? Math.max(0, left - 14 - width) : left + 14}px`;
    this.tooltip.style.top = `${Math.max(0, Math.min(top, this.plot.over.clientHeight - height))}px`;
  }

  /** Multiplies the range of x by a factor, around a place in [0, 1]. */
  zoom(factor, around = 0.5) {
    const { min, max } = this.plot.scales.x;
    const center = min + (max - min) * around;
    this.range(center - (center - min) * factor, center + (max - center) * factor);
  }

  range(min, max) {
    const all = this.plot.data[0];
    const [low, high] = [all[0], all[all.length - 1]];
    if (max - min >= high - low) return this.reset();
    const shift = Math.max(low - min, 0) || Math.min(high - max, 0);
    return this.plot.setScale("x", { min: min + shift, max: max + shift });
  }

  reset() {
    const all = this.plot.data[0];
    this.plot.setScale("x", { min: all[0], max: all[all.length - 1] });
  }

  wheel(event) {
    if (!event.ctrlKey && !event.shiftKey) return;
    event.preventDefault();
    const box = this.plot.over.getBoundingClientRect();
    this.zoom((event.deltaY || event.deltaX) > 0 ? 1.25 : 0.8, (event.clientX - box.left) / box.width);
  }

  /** Shift and dragging move the visible range. */
  startPan(event) {
    if (!event.shiftKey || event.button !== 0) return;
    event.preventDefault();
    event.stopPropagation();
    const from = event.clientX;
    const { min, max } = this.plot.scales.x;
    const perPixel = (max - min) / this.plot.over.clientWidth;
    const move = (moved) => this.range(min - (moved.clientX - from) * perPixel, max - (moved.clientX - from) * perPixel);
    const end = () => document.removeEventListener("pointermove", move);
    document.addEventListener("pointermove", move);
    document.addEventListener("pointerup", end, { once: true });
  }

  key(event) {
    const last = this.plot.data[0].length - 1;
    const at = this.plot.cursor.idx ?? 0;
    const to = { ArrowLeft: at - 1, ArrowRight: at + 1, Home: 0, End: last }[event.key];
    if (to !== undefined) {
      const idx = Math.min(Math.max(to, 0), last);
      const value = this.plot.data.slice(1).map((values) => values[idx]).find((value) => value !== null && value !== undefined);
      const top = value === undefined ? 0 : this.plot.valToPos(value, "y");
      this.plot.setCursor({ left: this.plot.valToPos(this.plot.data[0][idx], "x"), top });
    } else if (event.key === "+" || event.key === "=") {
      this.zoom(0.7);
    } else if (event.key === "-") {
      this.zoom(1.4);
    } else if (event.key === "0" || event.key === "Escape") {
      this.reset();
    } else {
      return;
    }
    event.preventDefault();
  }

  remove() {
    this.plot.destroy();
    this.box.remove();
  }
}
