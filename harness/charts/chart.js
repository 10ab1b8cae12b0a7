// Charts by uPlot, with marks, intervals, a tooltip of the nearest point, and keys.

/** The colors of series, as the style sheet names them. */
const COLORS = ["first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth"];
const DASHES = { dashed: [6, 4], dotted: [2, 3] };
/** The farthest that a point is from the pointer that shows it, px. */
const REACH = 40;
/** The most values in a tooltip, and the most that are named because they lie beyond the axis. */
const MOST_VALUES = 6;
/** The width of a letter and the height of a line below an axis, px. */
const [LETTER, LINE] = [7, 18];

// --- Themes ---

/** The charts on the page. */
const painted = new Set();
const inks = new Map();

/** The color that a variable of the style sheet has in the present theme. */
function ink(name) {
  if (!inks.has(name)) {
    const probe = element("i");
    probe.style.color = `var(--${name})`;
    document.body.append(probe);
    inks.set(name, getComputedStyle(probe).color);
    probe.remove();
  }
  return inks.get(name);
}

/** Draws all charts in the colors of a theme. */
function paint(theme) {
  document.documentElement.style.colorScheme = theme;
  inks.clear();
  forgetRemoved();
  for (const chart of painted) chart.show(chart.content);
}
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => paint(""));
addEventListener("beforeprint", () => paint("light"));
addEventListener("afterprint", () => paint(""));

/** Lets go of the charts that were taken from the page. */
function forgetRemoved() {
  for (const chart of painted) if (!chart.frame.isConnected) chart.remove();
}

// --- Marks and legends ---

/** The shapes of marks. Those of points beyond an axis point away from it. */
const MARKS = {
  dot: new Path2D("M-2.6 0a2.6 2.6 0 1 0 5.2 0a2.6 2.6 0 1 0 -5.2 0z"),
  disc: new Path2D("M-3.6 0a3.6 3.6 0 1 0 7.2 0a3.6 3.6 0 1 0 -7.2 0z"),
  square: new Path2D("M-3.2 -3.2h6.4v6.4h-6.4z"),
  bar: new Path2D("M-1.8 -4.6h3.6v9.2h-3.6z"),
  diamond: new Path2D("M0 -4.8L4.8 0L0 4.8L-4.8 0z"),
  above: new Path2D("M-4 3h8L0 -3z"),
  below: new Path2D("M-4 -3h8L0 3z"),
};

/** Draws a mark of a series at a place. */
function drawMark(pen, series, shape, [x, y]) {
  pen.save();
  pen.translate(x, y);
  pen.setLineDash([]);
  Object.assign(pen, { fillStyle: ink(series.hollow ? "ground" : series.color), strokeStyle: ink(series.color), lineWidth: 1.5 });
  pen.fill(MARKS[shape]);
  // The outlines of transparent marks would be darker.
  if (!series.alpha) pen.stroke(MARKS[shape]);
  pen.restore();
}

/** A sample of a series' line and mark. */
function swatch(series) {
  const [width, height] = [28, 14];
  const canvas = element("canvas", { width: width * devicePixelRatio, height: height * devicePixelRatio, "aria-hidden": "true" });
  const pen = canvas.getContext("2d");
  pen.scale(devicePixelRatio, devicePixelRatio);
  if (series.line) {
    Object.assign(pen, { strokeStyle: ink(series.color), lineWidth: series.width ?? 1.8 });
    pen.setLineDash(DASHES[series.dash] ?? []);
    pen.stroke(new Path2D(`M1 ${height / 2}H${width - 1}`));
  }
  if (series.kind) drawMark(pen, series, series.kind, [width / 2, height / 2]);
  return canvas;
}

const entryOf = (series) => series.entry ?? series.name;

/** The legend of charts with the same series. A click on an entry hides its series in all of them, or shows them again. */
class Legend {
  constructor() {
    this.list = element("ul", { class: "legend" });
    this.charts = new Set();
    /** The entries that are hidden. */
    this.hidden = new Set();
  }

  /** Shows an entry for each different entry of the series with a name. */
  show(series) {
    const named = series.filter((one) => one.name);
    const first = named.filter((one, place) => named.findIndex((other) => entryOf(other) === entryOf(one)) === place);
    const front = [...first.filter((one) => !one.behind), ...first.filter((one) => one.behind)];
    this.list.replaceChildren(...front.map((one) => element("li", {}, this.button(one))));
  }

  button(series) {
    const entry = entryOf(series);
    const tell = () => button.setAttribute("aria-pressed", String(!this.hidden.has(entry)));
    const click = () => {
      if (!this.hidden.delete(entry)) this.hidden.add(entry);
      tell();
      for (const chart of this.charts) chart.hideSeries();
    };
    const button = element("button", { type: "button", click }, swatch(series), entry);
    tell();
    return button;
  }
}

// --- Charts ---

/** Says what the pointer, the fingers and the keys do. */
function hint() {
  const mouse = "Drag to zoom, Shift and drag to pan, double-click to see everything. Click a name to hide it. Keys: arrows, +, \u2212, 0.";
  const touch = "Pinch to zoom, drag to pan. Tap a name to hide it.";
  return element("p", { class: "hint" }, element("span", { class: "mouse" }, mouse), element("span", { class: "touch" }, touch));
}

/** Moves a range into another one. A range that is too long becomes the other one. */
function within([low, high], [first, last]) {
  if (high - low >= last - first) return [first, last];
  const shift = Math.max(first - low, 0) || Math.min(last - high, 0);
  return [low + shift, high + shift];
}

/** Round values from low to high, about `count` of them. */
function ticks(low, high, count) {
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= rough * 0.999);
  const first = Math.ceil(low / step - 1e-6);
  const last = Math.floor(high / step + 1e-6);
  return Array.from({ length: last - first + 1 }, (_, index) => (first + index) * step);
}

/** Powers of ten from low to high. A shorter axis also has multiples of them, and a very short one has round values. */
function logarithmicTicks(low, high) {
  const length = Math.log10(high / low);
  if (length < 0.3) return ticks(low, high, 4);
  const factors = length < 1 ? [1, 1.5, 2, 3, 5, 7] : length < 2.5 ? [1, 2, 5] : [1];
  const all = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power += 1) {
    for (const factor of factors) all.push(factor * 10 ** power);
  }
  return all.filter((tick) => tick >= low * 0.999 && tick <= high * 1.001);
}

/** Divides a text at its spaces into lines of at most so many letters, if its words are not longer. */
function inLines(text, most) {
  const lines = [];
  for (const word of text.split(" ")) {
    if (lines.length && lines.at(-1).length + 1 + word.length <= most) lines[lines.length - 1] += ` ${word}`;
    else lines.push(word);
  }
  return lines;
}

/** The ends of an axis for values from min to max: with some room, and with 0 if no value is negative. */
function roomy(min, max) {
  const room = 0.04 * (max - Math.min(min, 0)) || 0.04 * Math.abs(max) || 1;
  return [min < 0 ? min - room : 0, max + room];
}

/** The table that uPlot draws lines from: all x, and a list of values for each series, with null where there is none. */
function tableOf(series) {
  const xs = distinct(series.flatMap((one) => one.points.map((point) => point.x)));
  return [xs, ...series.map(({ points }) => {
    const values = new Map(points.map((point) => [point.x, point.y]));
    return xs.map((x) => values.get(x) ?? null);
  })];
}

/**
 * A chart that is as wide as its place. A zoom is kept while the label of x stays the same, and that of y only if its
 * label stays the same too.
 *
 * The content has a `title`, axes `x` and `y`, and `series`. An axis has a `label`. `low` and `high` are the ends of the
 * axis; without them it ends with the points, and y with those that are visible. x may have `ticks` (`at` and `text`) or be `whole` numbers, and y may be
 * `logarithmic`. A `square` chart compares x with y.
 *
 * A series has a `color`, and optionally a `name`, a shorter `entry` for the legend, an `alpha`, `line` (whether it has a
 * line), its `width` and `dash`, `kind` (the shape of its marks), `hollow`, and `behind` (whether it lies behind others). A
 * series without a name has no tooltips. A point has `x`, `y`, and optionally `bounds` (the ends of its interval) and `says`
 * (the lines of its tooltip); without `says`, the tooltip has the values of all series at this x. A point beyond the ends of y
 * is at the end, with a mark that points away, and is named below the chart.
 *
 * Several small charts share a `legend`, which is not part of them.
 */
class Chart {
  constructor(place, legend) {
    this.small = legend !== undefined;
    this.legend = legend ?? new Legend();
    this.legend.charts.add(this);
    this.frame = element("div", { class: "plot", tabindex: "0", role: "group" });
    this.tooltip = element("div", { class: "tooltip", role: "status", hidden: "" });
    this.ring = element("div", { class: "ring", hidden: "" });
    this.beyond = element("p", { class: "beyond", hidden: "" });
    place.append(...(this.small ? [] : [this.legend.list]), this.frame, this.beyond);
    this.listen();
    this.observer = new ResizeObserver(() => this.fit());
  }

  fit() {
    if (this.frame.clientWidth !== this.plot.width) this.plot.setSize(this.size());
  }

  /** Lets go of everything outside of the chart, once it was taken from the page. */
  remove() {
    painted.delete(this);
    this.legend.charts.delete(this);
    this.observer.disconnect();
    this.plot.destroy();
  }

  isHidden(series) {
    return this.legend.hidden.has(entryOf(series));
  }

  size() {
    const wide = this.frame.clientWidth || 300;
    if (this.content.square) return { width: Math.min(wide, 560), height: Math.min(wide, 520) };
    return { width: wide, height: this.small ? Math.max(200, Math.min(320, wide * 0.6)) : Math.max(260, Math.min(420, wide * 0.5)) };
  }

  show(content) {
    const { x, y } = content;
    const kept = this.isZoomed && this.content.x.label === x.label ? { ...this.seen } : {};
    if (this.content?.y.label !== y.label) delete kept.y;
    const isThere = (point) => isNumber(point.y) && (!y.logarithmic || point.y > 0);
    const there = content.series.map((one) => ({ ...one, points: one.points.filter(isThere) }));
    this.content = { ...content, series: [...there.filter((one) => one.behind), ...there.filter((one) => !one.behind)] };
    const [low, high] = [y.low ?? -Infinity, y.high ?? Infinity];
    const clamped = (point) => ({ ...point, y: Math.min(Math.max(point.y, low), high) });
    const data = tableOf(this.content.series.map((one) => ({ points: one.points.map(clamped) })));
    const [first, last] = [x.low ?? data[0][0] ?? 0, x.high ?? data[0].at(-1) ?? 1];
    this.home = { x: [first, last > first ? last : first + 1], ...(y.low !== undefined && { y: [y.low, y.high] }) };
    this.plot?.destroy();
    this.plot = new uPlot(this.options(), data, this.frame);
    this.plot.root.querySelector("canvas").setAttribute("aria-hidden", "true");
    this.plot.over.append(this.ring, this.tooltip);
    const was = this.at;
    this.hide();
    this.look({ ...this.home, ...kept });
    this.legend.show(this.content.series);
    this.nameBeyond();
    const about = `${content.title}: ${y.label} over ${x.label}.`;
    this.frame.setAttribute("aria-label", `${about} Arrow keys go from point to point, plus and minus zoom, 0 shows everything.`);
    // The chart of a training grows while someone reads it.
    const series = was && this.told().find((one) => one.name === was.series.name);
    const point = series?.points.find((one) => one.x === was.point.x);
    if (point) this.tell(series, point);
    forgetRemoved();
    painted.add(this);
    this.observer.observe(this.frame);
    return this;
  }

  options() {
    const { x, y, series, square } = this.content;
    const { fontFamily } = getComputedStyle(document.body);
    const lines = { stroke: () => ink("line"), width: 1 };
    const axis = {
      stroke: () => ink("faint"), font: `12px ${fontFamily}`, labelFont: `12px ${fontFamily}`, labelSize: 20,
      grid: lines, ticks: { show: false }, values: (_, splits) => splits.map(shown),
    };
    const across = { ...axis, grid: { show: false }, size: 28, border: { show: true, ...lines, stroke: () => ink("faint") }, label: x.label };
    if (x.whole) across.incrs = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000];
    if (x.ticks) {
      const texts = new Map(x.ticks.map(({ at, text }) => [at, text]));
      across.splits = (_, index, min, max) => [...texts.keys()].filter((at) => at >= min && at <= max);
      // Long texts have several lines. Those that would still overlap are left out.
      across.values = (plot, splits) => {
        const room = plot.bbox.width / devicePixelRatio / splits.length;
        const lines = splits.map((at) => inLines(texts.get(at), Math.floor((room - LETTER) / LETTER)));
        const longest = Math.max(...lines.flat().map((line) => line.length));
        const every = Math.ceil((LETTER * longest + LETTER) / room);
        return lines.map((text, place) => (place % every ? "" : text.join("\n")));
      };
      across.size = (_, values) => 28 + LINE * Math.max(0, ...(values ?? []).map((text) => text.split("\n").length - 1));
    }
    const up = { ...axis, label: y.label, size: 50, gap: 4 };
    if (y.logarithmic) Object.assign(up, { splits: (_, index, min, max) => logarithmicTicks(min, max), filter: (_, splits) => splits });
    const isFixed = y.low !== undefined;
    // Without visible values there are no ends.
    const around = (_, min, max) => (y.logarithmic ? [(min ?? 0.1) / 1.06, (max ?? 1) * 1.06] : roomy(min ?? 0, max ?? 1));
    return {
      ...this.size(),
      scales: {
        x: { time: false, range: (_, min, max) => [min ?? 0, max ?? 1] },
        y: { distr: y.logarithmic ? 3 : 1, auto: !isFixed, range: isFixed ? [y.low, y.high] : around },
      },
      axes: [across, up],
      series: [{}, ...series.map((one) => ({
        label: one.name ?? "", stroke: () => ink(one.color), width: one.width ?? 1.8, dash: DASHES[one.dash], alpha: one.alpha ?? 1,
        show: !this.isHidden(one), spanGaps: true, points: { show: false }, ...(!one.line && { paths: () => null }),
      }))],
      legend: { show: false },
      padding: [10, 14, 0, 0],
      // A drag of a few pixels up or down does not zoom y.
      cursor: { x: false, y: false, points: { show: false }, drag: { x: true, y: isFixed, dist: 5, uni: square ? null : 40, setScale: false } },
      hooks: {
        drawSeries: [(_, place) => this.drawPoints(series[place - 1])],
        setSelect: [() => this.select()],
      },
    };
  }

  // --- Drawing ---

  /** Draws the intervals and marks of a series over its line. */
  drawPoints(series) {
    const { ctx: pen, bbox, over, width } = this.plot;
    const ratio = pen.canvas.width / width;
    const { low, high } = this.content.y;
    pen.save();
    // The unit of the pen is a pixel of the page, from the corner of the plotted area.
    pen.setTransform(ratio, 0, 0, ratio, bbox.left, bbox.top);
    pen.globalAlpha = series.alpha ?? 1;
    for (const point of series.kind ? series.points : []) {
      const place = this.placeOf(point);
      if (!place) continue;
      if (point.bounds) {
        Object.assign(pen, { strokeStyle: ink(series.color), lineWidth: 1.2 });
        pen.setLineDash([]);
        pen.beginPath();
        const ends = point.bounds.map((bound) => this.plot.valToPos(bound, "y"));
        for (const end of ends) pen.lineTo(place[0], Math.min(Math.max(end, 0), over.clientHeight));
        pen.stroke();
      }
      drawMark(pen, series, point.y > high ? "above" : point.y < low ? "below" : series.kind, place);
    }
    pen.restore();
  }

  /** The place of a point in the plotted area, or nothing if it is not visible. */
  placeOf(point) {
    const { x, y } = this.plot.scales;
    const { low = -Infinity, high = Infinity } = this.content.y;
    const height = Math.min(Math.max(point.y, low), high);
    if (point.x < x.min || point.x > x.max || height < y.min || height > y.max) return null;
    return [this.plot.valToPos(point.x, "x"), this.plot.valToPos(height, "y")];
  }

  // --- Zooming ---

  /** A range of each axis that can be zoomed. */
  ranges(of) {
    return Object.fromEntries(Object.keys(this.home).map((axis) => [axis, of(axis)]));
  }

  /** Shows these ranges, as far as there is anything. */
  look(wanted) {
    const ranges = this.ranges((axis) => within(wanted[axis], this.home[axis]));
    const lengths = Object.keys(this.home).map((axis) => (ranges[axis][1] - ranges[axis][0]) / (this.home[axis][1] - this.home[axis][0]));
    if (lengths.some((length) => !(length > 1e-6))) return;
    this.isZoomed = lengths.some((length) => length < 1);
    this.seen = ranges;
    this.plot.batch(() => {
      for (const [axis, [min, max]] of Object.entries(ranges)) this.plot.setScale(axis, { min, max });
    });
    if (this.at) this.tell(this.at.series, this.at.point);
  }

  /**
   * Zooms by a factor, and moves what was at the place `from` to the place `to`. Places are parts of the plotted area, from its
   * lower left corner.
   */
  zoom(factor, from, to = from) {
    this.look(this.ranges((axis) => {
      const [low, high] = this.seen[axis];
      const length = (high - low) * factor;
      const start = low + from[axis] * (high - low) - to[axis] * length;
      return [start, start + length];
    }));
  }

  /** Shows what was selected by dragging. */
  select() {
    const { left, top, width, height } = this.plot.select;
    const ends = { x: [left, left + width], y: [top + height, top] };
    if (width > 0) this.look(this.ranges((axis) => ends[axis].map((end) => this.plot.posToVal(end, axis))));
    this.plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
  }

  // --- Pointers and keys ---

  listen() {
    // Fingers, and a mouse with Shift, hold the chart.
    const held = new Map();
    const at = (event) => {
      const box = this.plot.over.getBoundingClientRect();
      return { x: (event.clientX - box.left) / box.width, y: (box.bottom - event.clientY) / box.height };
    };
    const hold = () => {
      const all = [...held.values()];
      const mean = (axis) => all.reduce((sum, place) => sum + place[axis], 0) / all.length;
      const spread = all.length > 1 ? Math.hypot(all[0].x - all[1].x, all[0].y - all[1].y) : 1;
      return { center: { x: mean("x"), y: mean("y") }, spread: Math.max(spread, 0.01) };
    };
    const down = (event) => {
      // Marks at the edge of the plotted area reach over it.
      if (event.pointerType === "touch") this.pointAt(at(event));
      if (!this.plot.over.contains(event.target)) return;
      if (event.pointerType === "touch") {
        held.set(event.pointerId, at(event));
      } else if (event.shiftKey && event.button === 0) {
        held.set(event.pointerId, at(event));
        this.frame.setPointerCapture(event.pointerId);
        // Otherwise uPlot would select a range.
        event.preventDefault();
      }
    };
    const move = (event) => {
      if (held.has(event.pointerId)) {
        const from = hold();
        held.set(event.pointerId, at(event));
        const to = hold();
        this.zoom(from.spread / to.spread, from.center, to.center);
      }
      if (held.size === 0 || (event.pointerType === "touch" && !this.isZoomed)) this.pointAt(at(event));
    };
    const release = (event) => held.delete(event.pointerId);
    this.frame.addEventListener("pointerdown", down, { capture: true });
    this.frame.addEventListener("pointermove", move);
    this.frame.addEventListener("pointerleave", (event) => event.pointerType !== "touch" && this.hide());
    for (const kind of ["pointerup", "pointercancel"]) this.frame.addEventListener(kind, release);
    this.frame.addEventListener("dblclick", () => this.look(this.home));
    this.frame.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.shiftKey) return;
      event.preventDefault();
      this.zoom((event.deltaY || event.deltaX) > 0 ? 1.25 : 0.8, at(event));
    }, { passive: false });
    this.frame.addEventListener("blur", () => this.hide());
    this.frame.addEventListener("keydown", (event) => this.key(event));
  }

  /** The series that have tooltips, each with points. */
  told() {
    return this.content.series.filter((series) => series.name && !this.isHidden(series) && series.points.length > 0);
  }

  /** Shows the point that is nearest to a place, if one is near. */
  pointAt({ x, y }) {
    const { clientWidth, clientHeight } = this.plot.over;
    const [left, top] = [x * clientWidth, (1 - y) * clientHeight];
    let best = { distance: REACH };
    for (const series of this.told()) {
      for (const point of series.points) {
        const place = this.placeOf(point);
        if (!place) continue;
        // If marks overlap, the one in front is chosen.
        const distance = Math.hypot(place[0] - left, place[1] - top) + (series.behind ? 6 : 0);
        if (distance < best.distance) best = { distance, series, point };
      }
    }
    if (best.point) this.tell(best.series, best.point);
    else this.hide();
  }

  key(event) {
    const side = { ArrowLeft: -1, ArrowRight: 1, Home: -Infinity, End: Infinity }[event.key];
    const turn = { ArrowUp: -1, ArrowDown: 1 }[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (side !== undefined || turn !== undefined) this.step(side ?? 0, turn ?? 0);
    else if (event.key === "+" || event.key === "=") this.zoom(0.7, this.center());
    else if (event.key === "-") this.zoom(1.4, this.center());
    else if (event.key === "0") this.look(this.home);
    else if (event.key === "Escape") this.hide();
    else return;
    event.preventDefault();
  }

  /** The place of the chosen point, or the middle. */
  center() {
    if (!this.at) return { x: 0.5, y: 0.5 };
    const [x, y] = this.placeOf(this.at.point);
    return { x: x / this.plot.over.clientWidth, y: 1 - y / this.plot.over.clientHeight };
  }

  /** Goes to another point of the series, or to another series. A point that is not visible is brought into view. */
  step(side, turn) {
    const told = this.told();
    if (told.length === 0) return;
    const front = told.find((series) => !series.behind) ?? told[0];
    const place = told.indexOf(this.at ? this.at.series : front);
    const series = told[(place + turn + told.length) % told.length];
    const index = this.at ? this.at.series.points.indexOf(this.at.point) : side > 0 && side < Infinity ? -1 : 0;
    const point = series.points[Math.min(Math.max(index + side, 0), series.points.length - 1)];
    if (!this.placeOf(point)) {
      this.look(this.ranges((axis) => {
        const half = (this.seen[axis][1] - this.seen[axis][0]) / 2;
        return [point[axis] - half, point[axis] + half];
      }));
    }
    this.tell(series, point);
  }

  // --- The tooltip ---

  tell(series, point) {
    const place = this.placeOf(point);
    if (!place) return this.hide();
    this.at = { series, point };
    const [x, y] = place;
    const lines = point.says ? [series.name, ...point.says] : this.valuesAt(point.x, y);
    this.tooltip.replaceChildren(element("b", {}, lines[0]), ...lines.slice(1).map((line) => element("span", {}, line)));
    this.tooltip.hidden = false;
    this.ring.hidden = false;
    Object.assign(this.ring.style, { left: `${x}px`, top: `${y}px` });
    const [width, height] = [this.tooltip.offsetWidth, this.tooltip.offsetHeight];
    const room = this.plot.over.clientWidth;
    const left = x + 14 + width > room ? x - 14 - width : x + 14;
    Object.assign(this.tooltip.style, { left: `${Math.max(0, Math.min(left, room - width))}px`, top: `${Math.max(0, y - height - 10)}px` });
    return undefined;
  }

  /** The values of all series at this x, the nearest to a height first. */
  valuesAt(x, height) {
    const near = this.told().flatMap((series) => series.points.filter((point) => point.x === x).map((point) => ({ series, point })))
      .map((one) => ({ ...one, distance: Math.abs(this.plot.valToPos(one.point.y, "y") - height) }))
      .sort((a, b) => a.distance - b.distance).slice(0, MOST_VALUES);
    return [`${this.content.x.label} ${this.textOf(x)}`, ...near.map(({ series, point }) => `${series.name}: ${shown(point.y)}`)];
  }

  /** The text of a value of x. */
  textOf(x) {
    return this.content.x.ticks?.find(({ at }) => at === x)?.text ?? shown(x);
  }

  /** Names the points beyond the ends of y below the chart. A series with a single value is named without its places. */
  nameBeyond() {
    const { series, y } = this.content;
    const isBeyond = (point) => point.y < (y.low ?? -Infinity) || point.y > (y.high ?? Infinity);
    const words = (one, point) => {
      const isFlat = one.points.every((other) => other.y === point.y);
      return `${one.name}${isFlat ? "" : ` at ${this.textOf(point.x)}`}: ${shown(point.y)}`;
    };
    const named = series.filter((one) => one.name);
    const all = distinct(named.flatMap((one) => one.points.filter(isBeyond).map((point) => words(one, point))));
    const more = all.length > MOST_VALUES ? [`${all.length - MOST_VALUES} more`] : [];
    this.beyond.textContent = `Beyond the axis: ${[...all.slice(0, MOST_VALUES), ...more].join("; ")}.`;
    this.beyond.hidden = all.length === 0;
  }

  hide() {
    this.at = undefined;
    this.tooltip.hidden = true;
    this.ring.hidden = true;
  }

  // --- Series ---

  /** Hides and shows the series as the legend says. */
  hideSeries() {
    this.hide();
    this.plot.batch(() => {
      this.content.series.forEach((series, place) => this.plot.setSeries(place + 1, { show: !this.isHidden(series) }));
    });
    this.look(this.seen);
  }
}
