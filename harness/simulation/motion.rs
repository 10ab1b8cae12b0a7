//! The motion of the actuators: smoothstep moves between random setpoints.

use super::timing::Timing;
use harness_spec::Simulation;
use rand::{Rng, RngExt};

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

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn timing() -> Timing {
        Timing::new(&Simulation::default(), 1e-3).unwrap()
    }

    #[test]
    fn moves_are_continuous_in_range_and_half_way_at_half_time() {
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
