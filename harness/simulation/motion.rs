//! The motion of the actuators: smoothstep moves between random setpoints, on an exact time grid.

use super::SimulationError;
use super::scene::{Scene, within};
use harness_spec::{Simulation, Start};
use rand::{Rng, RngExt};

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

/// The setpoint as a function of time.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Motion {
    /// Start and end of the moves, `[moves + 1, elements]`.
    waypoints: Vec<f64>,
    elements: usize,
    steps_per_move: usize,
}

impl Motion {
    /// Draws a uniformly random waypoint for each of the spec's actuations. The motion starts at `rest`.
    pub fn draw(
        ranges: &[[f64; 2]],
        rest: &[f64],
        spec: &Simulation,
        timing: &Timing,
        rng: &mut impl Rng,
    ) -> Self {
        let random = (0..spec.actuations_per_episode).flat_map(|_| ranges);
        let random = random.map(|[low, high]| rng.random_range(*low..=*high));
        let waypoints = rest.iter().copied().chain(random).collect();
        Self { waypoints, elements: ranges.len(), steps_per_move: timing.steps_per_actuation }
    }

    /// Writes the setpoint at the start of a step to `setpoint`. After the last move, it is the last waypoint.
    pub fn setpoint(&self, step: usize, setpoint: &mut [f64]) {
        let (index, last) = (step / self.steps_per_move, self.waypoints.len() / self.elements - 1);
        let [from, to] =
            [index, index + 1].map(|i| &self.waypoints[i.min(last) * self.elements..][..self.elements]);
        let done = smoothstep((step % self.steps_per_move) as f64 / self.steps_per_move as f64);
        for (value, (from, to)) in setpoint.iter_mut().zip(from.iter().zip(to)) {
            *value = from + done * (to - from);
        }
    }
}

/// Returns 3 u^2 - 2 u^3, which rises from 0 to 1 with zero velocity at both ends.
fn smoothstep(u: f64) -> f64 {
    u * u * (3.0 - 2.0 * u)
}

/// Returns the range of each element of the setpoint.
pub(super) fn ranges(scene: &Scene, spec: &Simulation) -> Vec<[f64; 2]> {
    let own = scene.world().file().action.actuators.iter();
    let range = |(driven, (_, own)): (&super::scene::Driven, (&str, &harness_spec::Actuator))| {
        spec.range(&driven.setting).unwrap_or(own.range)
    };
    scene.actuators.iter().zip(own).map(range).collect()
}

/// Returns the setpoint at the start of every episode.
pub(super) fn rest(scene: &Scene, spec: &Simulation) -> Vec<f64> {
    let actuators = scene.world().file().action.actuators.iter();
    let start =
        |([low, high], (_, actuator)): ([f64; 2], (&str, &harness_spec::Actuator))| match actuator.start {
            Start::Low => low,
            Start::Middle => 0.5 * (low + high),
            Start::High => high,
        };
    ranges(scene, spec).into_iter().zip(actuators).map(start).collect()
}

/// Refuses ranges that exceed the limits of the scene's joints or actuators.
///
/// # Errors
/// When a range is reversed or exceeds the limits. The error names the range and the limits.
pub(super) fn check_ranges(spec: &Simulation, scene: &Scene) -> Result<(), SimulationError> {
    for ([low, high], driven) in ranges(scene, spec).into_iter().zip(&scene.actuators) {
        if !within([low, high], driven.limits) {
            let [min, max] = driven.limits;
            let problem = format!(
                "[{low}, {high}] must ascend and lie within [{min}, {max}], as {} allows",
                scene.name
            );
            return Err(SimulationError::Spec { field: driven.setting.clone(), problem });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn timing() -> Timing {
        Timing::new(&Simulation::default(), 1e-3).unwrap()
    }

    #[test]
    fn time_grid_of_the_defaults() {
        let expected =
            Timing { step_s: 1e-3, steps_per_sample: 100, steps_per_actuation: 1000, samples: 200 };
        assert_eq!(timing(), expected);
    }

    #[test]
    fn rates_off_the_grid_are_refused() {
        let spec = Simulation { sample_rate_hz: 300.0, ..Default::default() };
        assert!(Timing::new(&spec, 1e-3).unwrap_err().to_string().contains("sample_rate_hz"));
        let spec = Simulation { actuation_seconds: 0.25, ..Default::default() };
        assert!(Timing::new(&spec, 1e-3).unwrap_err().to_string().contains("actuation_seconds"));
    }

    #[test]
    fn moves_are_continuous_within_the_ranges_and_half_way_at_half_time() {
        let (spec, ranges, rest) = (Simulation::default(), [[-1.0, 2.0], [0.0, 1.5]], [0.5, 0.0]);
        let motion = Motion::draw(&ranges, &rest, &spec, &timing(), &mut ChaCha8Rng::seed_from_u64(7));
        let setpoint = |step: usize| {
            let mut setpoint = [0.0; 2];
            motion.setpoint(step, &mut setpoint);
            setpoint
        };
        assert_eq!(setpoint(0), rest);
        let (first, second) = (setpoint(1000), setpoint(2000));
        assert_ne!(first, second);
        for joint in 0..2 {
            assert!((setpoint(1500)[joint] - 0.5 * (first[joint] + second[joint])).abs() < 1e-12);
            // smoothstep(1/4) = 5/32
            let quarter = first[joint] + 5.0 / 32.0 * (second[joint] - first[joint]);
            assert!((setpoint(1250)[joint] - quarter).abs() < 1e-12);
        }
        for step in 0..100_000 {
            let (here, next) = (setpoint(step), setpoint(step + 1));
            for (joint, [low, high]) in ranges.into_iter().enumerate() {
                assert!((low..=high).contains(&here[joint]));
                // The smoothstep's steepest slope is 1.5 spans a move.
                assert!((next[joint] - here[joint]).abs() <= 1.5 * (high - low) / 1000.0 + 1e-12);
            }
        }
        assert_eq!(setpoint(100_000), setpoint(123_456));
    }
}
