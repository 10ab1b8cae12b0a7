//! How much of a network's latent state is used.

use super::{Metric, Row};
use harness_spec::Modality;

/// A dimension of the latent state is active if its divergence is larger than this, in nats. Another dimension hardly
/// depends on what the network sees (posterior collapse).
pub const ACTIVE_NATS: f64 = 0.01;

/// Returns the rows of the metrics table about a latent state: the sum of its divergences, the number of active
/// dimensions, and each divergence. `divergences` has the mean of each dimension over the test windows, in nats; it is
/// empty if there are none.
pub fn rows(divergences: &[f64]) -> Vec<Row> {
    if divergences.is_empty() {
        return Vec::new();
    }
    let row = |metric: Metric, index: Option<u32>, value: f64, unit: &str| Row {
        modality: Modality::LATENT,
        direction: None,
        index,
        metric,
        value: Some(value),
        unit: unit.to_owned(),
    };
    let active = divergences.iter().filter(|nats| **nats > ACTIVE_NATS).count();
    let of_all = [
        row(Metric::Kl, None, divergences.iter().sum(), "nats"),
        row(Metric::Active, None, active as f64, "dimensions"),
    ];
    let of_each = (0..).zip(divergences).map(|(index, nats)| row(Metric::Kl, Some(index), *nats, "nats"));
    of_all.into_iter().chain(of_each).collect()
}
