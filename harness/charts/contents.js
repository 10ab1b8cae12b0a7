// What charts of both pages have in common: axes, and the looks of models.

/** The models that are not networks. */
const BASELINES = ["persistence", "training_mean", "ridge", "nearest_neighbors"];
const METRICS = { r2: "R\u00b2", rmse: "RMSE", mae: "MAE", smape: "SMAPE", wmape: "WMAPE" };
/** An outlier is at least this many times as far from the other values as these are from each other. */
const FAR = 9;

const spaced = (name) => name.replaceAll("_", " ");
const metricWords = (name) => METRICS[name] ?? spaced(name);
const withUnit = (words, unit) => (unit === "1" || unit === "" ? words : `${words} (${unit})`);

/** The look of a model's line. Baselines are dotted, and lie behind networks. */
function lookOfModel(model, color) {
  const behind = BASELINES.includes(model);
  return { color, line: true, dash: behind ? "dotted" : undefined, kind: behind ? "diamond" : "disc", behind };
}

// --- Axes ---

/** An axis of texts beside each other. */
function axisOfTexts(label, texts) {
  return { label, low: -0.5, high: texts.length - 0.5, ticks: texts.map((text, at) => ({ at, text })) };
}

/** The ends of an axis of numbers, with a margin, which is a part of its length. */
function withMargin(numbers, part = 0.04) {
  const [low, high] = extent(numbers);
  const margin = part * (high - low) || 1;
  return { low: low - margin, high: high + margin };
}

/** The place of a horizon on its axis, which is logarithmic. */
const horizonPlace = (horizon) => Math.log10(horizon);

/** The axis of horizons in samples, of which each takes some seconds, if that is known. */
function horizonAxis(horizons, seconds) {
  const known = seconds !== null && seconds !== undefined;
  const ticks = horizons.map((horizon) => ({ at: horizonPlace(horizon), text: shown(known ? horizon * seconds : horizon) }));
  return { label: known ? "horizon (s)" : "horizon (samples)", ...withMargin(horizons.map(horizonPlace)), ticks };
}

/** The axis of a metric. Its range is chosen for the networks. Baselines may lie beyond it. */
function metricAxis(metric, unit, series) {
  const label = withUnit(metricWords(metric), unit);
  const numbers = (some, of) => some.flatMap((one) => one.points.flatMap(of)).filter(isNumber);
  const networks = series.filter((one) => !one.behind);
  const front = networks.length ? networks : series;
  const means = numbers(front, (point) => point.y);
  const ends = numbers(front, (point) => [point.y, ...(point.bounds ?? [])]);
  // The metric isn't defined for any point. For example, a link that is never touched has no percentage.
  if (means.length === 0) return { label, low: 0, high: 1 };
  // R2 and skill have no lower bound, but values below -1 need not be told apart. The skill of persistence is 0.
  if (metric === "skill" || /(^|_)r2(_|$)/.test(metric)) {
    return { label, low: Math.max(-1, Math.floor(Math.min(metric === "skill" ? 0 : 0.9, ...ends) * 10) / 10), high: 1 };
  }
  const [least, most] = extent(means);
  const room = 0.4 * (most - Math.min(least, 0));
  const [bottom, top] = extent([...ends, ...numbers(series, (point) => point.y)]);
  const [low, high] = roomy(least < 0 ? Math.max(bottom, least - room) : 0, Math.min(top, most + room));
  return { label, low, high };
}

/**
 * The ends `low` and `high` of an axis without outliers, which would leave a small part of it to all other values. Nothing if there
 * are none. Outliers are fewer than half of the values.
 */
function withoutOutliers(values) {
  const sorted = values.filter(isNumber).sort((a, b) => a - b);
  for (let kept = sorted.length - 1; kept > sorted.length / 2; kept -= 1) {
    for (let place = 0; place + kept <= sorted.length; place += 1) {
      const [min, max] = [sorted[place], sorted[place + kept - 1]];
      const length = max - Math.min(min, 0);
      const gap = Math.min(min - (sorted[place - 1] ?? -Infinity), (sorted[place + kept] ?? Infinity) - max);
      if (length > 0 && gap >= FAR * length) {
        const [low, high] = roomy(min, max);
        return { low, high };
      }
    }
  }
  return {};
}
