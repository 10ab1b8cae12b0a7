//! The time grid of an episode: steps, samples and actuations.

use super::SimulationError;
use harness_spec::Simulation;

/// Steps, samples and actuations of an episode. They are integers, so that rounding can't shift an instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Timing {
    /// Duration of a step, s.
    pub step_s: f64,
    pub steps_per_sample: usize,
    pub steps_per_actuation: usize,
    /// Number of samples in an episode.
    pub samples: usize,
}

impl Timing {
    /// Computes the timing for a simulation step of `step_s` seconds.
    ///
    /// # Errors
    /// When a sampling interval is not a whole number of steps, or an actuation is not a whole number of samples.
    pub fn new(spec: &Simulation, step_s: f64) -> Result<Self, SimulationError> {
        let steps_per_sample = whole(1.0 / (spec.sample_rate_hz * step_s)).ok_or_else(|| SimulationError::Spec {
            field: "sample_rate_hz".into(),
            problem: format!(
                "a whole number of steps of {step_s} s must fit between samples, which {} Hz does not give",
                spec.sample_rate_hz
            ),
        })?;
        let samples_per_actuation =
            whole(spec.actuation_seconds * spec.sample_rate_hz).ok_or_else(|| SimulationError::Spec {
                field: "actuation_seconds".into(),
                problem: format!(
                    "{} s must hold a whole number of samples at {} Hz",
                    spec.actuation_seconds, spec.sample_rate_hz
                ),
            })?;
        Ok(Self {
            step_s,
            steps_per_sample,
            steps_per_actuation: samples_per_actuation * steps_per_sample,
            samples: spec.actuations_per_episode as usize * samples_per_actuation,
        })
    }
}

/// Returns the nearest integer if it is positive and `value` differs from it only by rounding.
fn whole(value: f64) -> Option<usize> {
    let nearest = value.round();
    let is_whole = (1.0..1e9).contains(&nearest) && (value - nearest).abs() < 1e-6 * nearest;
    is_whole.then_some(nearest as usize)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_grid_of_the_defaults() {
        let expected =
            Timing { step_s: 1e-3, steps_per_sample: 100, steps_per_actuation: 1000, samples: 200 };
        assert_eq!(Timing::new(&Simulation::default(), 1e-3).unwrap(), expected);
    }

    #[test]
    fn rates_off_the_grid_are_refused() {
        let spec = Simulation { sample_rate_hz: 300.0, ..Default::default() };
        assert!(Timing::new(&spec, 1e-3).unwrap_err().to_string().contains("sample_rate_hz"));
        let spec = Simulation { actuation_seconds: 0.25, ..Default::default() };
        assert!(Timing::new(&spec, 1e-3).unwrap_err().to_string().contains("actuation_seconds"));
    }
}
