//! Names and values of metrics for people.

use super::Metric;

/// The name of a metric for people, with the unit of the values.
pub fn label(metric: &str, unit: &str) -> String {
    let words = metric.split('_').map(|word| match word {
        "smape" | "wmape" | "r2" | "rmse" | "mae" | "kl" | "f1" | "auc" | "crps" | "pit" => {
            word.to_uppercase()
        }
        _ => word.to_owned(),
    });
    let name = words.collect::<Vec<_>>().join(" ");
    if unit == "1" { name } else { format!("{name} ({unit})") }
}

/// Whether higher values of the metric with this name are better; `None` for a metric that is no judgment, and for a
/// user's metric, of which this is unknown.
pub fn higher_is_better(metric: &str) -> Option<bool> {
    let metric = Metric::named(metric).filter(|metric| metric.is_judgment());
    metric.map(Metric::higher_is_better)
}

/// Whether each of some values of a metric is the best, as far as the printed digits show. None is if there are fewer
/// than two to choose from, if all of them are printed alike, or for a user's metric.
pub fn best(metric: &str, unit: &str, values: &[Option<f64>]) -> Vec<bool> {
    let there = || values.iter().copied().flatten();
    let best = match higher_is_better(metric) {
        Some(true) => there().max_by(f64::total_cmp),
        Some(false) => there().min_by(f64::total_cmp),
        None => None,
    };
    let best = best.map(|value| rounded(value, unit));
    let is_best = |value: f64| best.as_ref() == Some(&rounded(value, unit));
    let has_worse = best.is_some() && !there().all(is_best);
    values.iter().map(|value| has_worse && value.is_some_and(is_best)).collect()
}

/// A value of a metric, with the decimals that its unit needs.
pub fn rounded(value: f64, unit: &str) -> String {
    let decimals = match unit {
        "%" => 2,
        "1" | "nats" => 3,
        "samples" | "dimensions" => 1,
        _ => 4,
    };
    let number = format!("{value:.decimals$}");
    match number.strip_prefix('-') {
        Some(zero) if zero.chars().all(|digit| matches!(digit, '0' | '.')) => zero.to_owned(),
        _ => number,
    }
}
