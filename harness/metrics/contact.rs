//! The distribution of the force on a link.

/// The quantiles of the force in contact, with the names of their columns.
pub const QUANTILES: [(&str, f64); 5] =
    [("p05", 0.05), ("p25", 0.25), ("p50", 0.5), ("p75", 0.75), ("p95", 0.95)];

/// The force on one link over many samples, N.
#[derive(Debug, Clone, PartialEq)]
pub struct Contact {
    /// Number of samples.
    pub samples: usize,
    /// Number of samples in which the force is not 0. It is negative where adhesion pulls.
    pub contacts: usize,
    /// Mean force over all samples, N.
    pub mean: f64,
    /// [`QUANTILES`] of the force over the samples in contact, N, interpolated linearly as in NumPy; `None` without
    /// contact.
    pub quantiles: Option<[f64; QUANTILES.len()]>,
    /// Largest force in contact, N; `None` without contact.
    pub max: Option<f64>,
}

/// Returns the distribution of each link's force. `forces` is row-major `[samples, links]`, in N.
pub fn by_link(forces: &[f32], links: usize) -> Vec<Contact> {
    let column = |link: usize| forces.iter().skip(link).step_by(links).map(|&force| f64::from(force));
    (0..links).map(|link| of(column(link))).collect()
}

fn of(forces: impl Iterator<Item = f64>) -> Contact {
    let (mut samples, mut sum, mut touching) = (0, 0.0, Vec::new());
    for force in forces {
        samples += 1;
        sum += force;
        if force != 0.0 {
            touching.push(force);
        }
    }
    touching.sort_by(f64::total_cmp);
    let mean = if samples > 0 { sum / samples as f64 } else { 0.0 };
    let quantiles = (!touching.is_empty()).then(|| QUANTILES.map(|(_, share)| quantile(&touching, share)));
    Contact { samples, contacts: touching.len(), mean, quantiles, max: touching.last().copied() }
}

/// Returns a quantile of sorted values. There must be at least one value.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let place = share * (sorted.len() - 1) as f64;
    let (below, above) = (sorted[place.floor() as usize], sorted[place.ceil() as usize]);
    below + (above - below) * place.fract()
}
