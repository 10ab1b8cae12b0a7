// What charts of both pages have in common: axes, and the looks of models.

/** The models that are not networks. */
const BASELINES = ["persistence", "training_mean", "ridge", "nearest_neighbors"];
/** An outlier is at least this many times as far from the other values as these are from each other. */
const FAR = 9;

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

/** The axis of the epochs of a training. */
const EPOCHS = { label: "epoch", low: 1, whole: true };

/** The ends of an axis of numbers, with a margin, which is a part of its length. */
function withMargin(numbers, part = 0.04) {
  const [low, high] = extent(numbers);
  const margin = part * (high - low || Math.abs(high)) || 1;
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

/**
 * An axis that ends before the outliers of series, which would leave a small part of it to all other values. Outliers are fewer
 * than half of the values. Without any, the axis has no fixed ends.
 */
function axisWithoutOutliers(label, series) {
  const sorted = series.flatMap((one) => one.points.map((point) => point.y)).filter(isNumber).sort((a, b) => a - b);
  for (let kept = sorted.length - 1; kept > sorted.length / 2; kept -= 1) {
    for (let place = 0; place + kept <= sorted.length; place += 1) {
      const [min, max] = [sorted[place], sorted[place + kept - 1]];
      const length = max - Math.min(min, 0);
      const gap = Math.min(min - (sorted[place - 1] ?? -Infinity), (sorted[place + kept] ?? Infinity) - max);
      if (length > 0 && gap >= FAR * length) {
        const [low, high] = roomy(min, max);
        return { label, low, high };
      }
    }
  }
  return { label };
}
