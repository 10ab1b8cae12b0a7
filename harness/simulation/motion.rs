//! The motion of the actuators: smoothstep moves between random setpoints or those of a random walk, sinusoids, or a
//! recorded course. A probing motion is one of random setpoints whose clock depends on touch.

use super::timing::Timing;
use harness_spec::{Motion, Simulation};
use rand::{Rng, RngExt};
use std::f64::consts::TAU;

/// Largest step of a random walk, as a part of the range.
const STEP: f64 = 0.3;
/// The least and the largest amplitude of a sinusoid, as parts of the range.
const AMPLITUDE: [f64; 2] = [0.25, 0.5];
/// The lowest and the highest frequency of a sinusoid, periods per move. With the highest one and the largest
/// amplitude, a setpoint is at most as fast as in a move through the whole range.
const FREQUENCY: [f64; 2] = [0.1, 0.45];

/// How long the setpoint of a probing motion stays after a touch, as a part of a move.
const HOLD: f64 = 0.2;

/// The setpoint as a function of time.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Setpoints {
    /// Start and end of the moves, `[moves + 1, elements]`.
    waypoints: Vec<f64>,
    elements: usize,
    steps_per_move: usize,
    /// Whether moves begin and end at rest. Otherwise they have constant speed.
    eased: bool,
    /// The sinusoids of the elements; empty if the setpoints move between the waypoints.
    waves: Vec<Wave>,
}

/// A sinusoid.
#[derive(Debug, Clone, PartialEq)]
struct Wave {
    middle: f64,
    amplitude: f64,
    /// Periods per move.
    frequency: f64,
    /// Phase at the start, rad.
    phase: f64,
}

impl Setpoints {
    /// Draws a motion with as many moves as the spec has actuations. The motion starts at `rest`.
    pub fn draw(
        kind: Motion,
        ranges: &[[f64; 2]],
        rest: &[f64],
        spec: &Simulation,
        timing: &Timing,
        rng: &mut impl Rng,
    ) -> Self {
        let (elements, moves) = (ranges.len(), spec.actuations_per_episode);
        let mut motion = Self {
            waypoints: rest.to_vec(),
            elements,
            steps_per_move: timing.steps_per_actuation,
            eased: true,
            waves: Vec::new(),
        };
        match kind {
            Motion::RandomSetpoints | Motion::Probing => {
                let random = (0..moves).flat_map(|_| ranges);
                motion.waypoints.extend(random.map(|[low, high]| rng.random_range(*low..=*high)));
            }
            Motion::RandomWalk => {
                for place in 0..moves as usize * elements {
                    let ([low, high], from) = (ranges[place % elements], motion.waypoints[place]);
                    let most = STEP * (high - low);
                    motion.waypoints.push(reflected(from + rng.random_range(-most..=most), [low, high]));
                }
            }
            Motion::Sinusoids => {
                motion.waves = ranges.iter().map(|range| Wave::draw(*range, rng)).collect();
                // The waypoints tell only the start and the number of moves.
                motion.waypoints = rest.repeat(moves as usize + 1);
            }
        }
        motion
    }

    /// Returns a motion through the setpoints of a course's samples, `[samples, elements]`, with constant speed between
    /// two samples. It ends at the last one.
    pub fn through(course: &[f64], elements: usize, timing: &Timing) -> Self {
        Self {
            waypoints: course.to_vec(),
            elements,
            steps_per_move: timing.steps_per_sample,
            eased: false,
            waves: Vec::new(),
        }
    }

    /// Writes the setpoint at the start of a step to `setpoint`. After the last move, it is the last waypoint.
    pub fn setpoint(&self, step: usize, setpoint: &mut [f64]) {
        let (index, last) = (step / self.steps_per_move, self.waypoints.len() / self.elements - 1);
        if !self.waves.is_empty() {
            let moves = step.min(last * self.steps_per_move) as f64 / self.steps_per_move as f64;
            let reached = smoothstep(moves.min(1.0));
            for (value, (rest, wave)) in setpoint.iter_mut().zip(self.waypoints.iter().zip(&self.waves)) {
                *value = rest + reached * (wave.at(moves) - rest);
            }
            return;
        }
        let [from, to] =
            [index, index + 1].map(|i| &self.waypoints[i.min(last) * self.elements..][..self.elements]);
        let done = (step % self.steps_per_move) as f64 / self.steps_per_move as f64;
        let done = if self.eased { smoothstep(done) } else { done };
        for (value, (from, to)) in setpoint.iter_mut().zip(from.iter().zip(to)) {
            *value = from + done * (to - from);
        }
    }
}

/// The clock of a probing motion: the step of the motion whose setpoint is commanded. It stops at the first touch of
/// each move, runs back to the begin of the move, and then goes on through the whole move.
#[derive(Debug, Clone, Copy)]
pub(super) struct Probe {
    /// The step of the motion.
    pub clock: usize,
    phase: Phase,
    steps_per_move: usize,
    /// The first move whose touch still counts.
    ready_from: usize,
    /// Whether something was touched in the step before. Only what begins is a touch.
    is_touching: bool,
}

/// What a probing motion does.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Phase {
    On,
    /// Stays for this number of steps.
    Hold(usize),
    Back,
}

impl Probe {
    /// Creates the clock at the start of an episode.
    pub fn new(timing: &Timing) -> Self {
        let steps_per_move = timing.steps_per_actuation;
        Self { clock: 0, phase: Phase::On, steps_per_move, ready_from: 0, is_touching: true }
    }

    /// Advances the clock by a simulation step, in which something was touched or not.
    pub fn advance(&mut self, is_touching: bool) {
        let (begins, current) = (is_touching && !self.is_touching, self.clock / self.steps_per_move);
        self.is_touching = is_touching;
        match self.phase {
            Phase::On if begins && current >= self.ready_from => {
                self.ready_from = current + 1;
                self.phase = Phase::Hold((HOLD * self.steps_per_move as f64).ceil() as usize);
            }
            Phase::On => self.clock += 1,
            Phase::Hold(0) => self.phase = Phase::Back,
            Phase::Hold(left) => self.phase = Phase::Hold(left - 1),
            Phase::Back if self.clock.is_multiple_of(self.steps_per_move) => self.phase = Phase::On,
            Phase::Back => self.clock -= 1,
        }
    }
}

impl Wave {
    fn draw([low, high]: [f64; 2], rng: &mut impl Rng) -> Self {
        let amplitude = rng.random_range(AMPLITUDE[0]..=AMPLITUDE[1]) * (high - low);
        // Rounding must not make the ends of the middle's range cross.
        let middle = rng.random_range(low + amplitude..=(high - amplitude).max(low + amplitude));
        let frequency = rng.random_range(FREQUENCY[0]..=FREQUENCY[1]);
        Self { middle, amplitude, frequency, phase: rng.random_range(0.0..TAU) }
    }

    /// The value after a number of moves.
    fn at(&self, moves: f64) -> f64 {
        self.middle + self.amplitude * (TAU * self.frequency * moves + self.phase).sin()
    }
}

/// Reflects a value that is at most as far from a range as the range is wide.
fn reflected(value: f64, [low, high]: [f64; 2]) -> f64 {
    let value = if value < low { 2.0 * low - value } else { value };
    let value = if value > high { 2.0 * high - value } else { value };
    value.clamp(low, high)
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
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let motion = Setpoints::draw(Motion::RandomSetpoints, &ranges, &rest, &spec, &timing(), &mut rng);
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

    /// A move has 1000 steps. The first touch of a move counts, if it begins during the move.
    #[test]
    fn a_probe_stops_at_a_touch_goes_back_and_then_through() {
        let mut probe = Probe::new(&timing());
        let mut clocks = Vec::new();
        // Something is touched while the clock is in these steps.
        let touched = |clock: usize| (300..500).contains(&clock) || (1900..2100).contains(&clock);
        for _ in 0..6000 {
            clocks.push(probe.clock);
            probe.advance(touched(probe.clock));
        }
        assert!(clocks.windows(2).all(|pair| pair[0].abs_diff(pair[1]) <= 1));
        let count = |clock: usize| clocks.iter().filter(|other| **other == clock).count();
        // There, back, and there again: three times, and 200 steps of holding. Beyond the touch: once.
        assert_eq!((count(299), count(301), count(999)), (3, 1, 1));
        assert!((201..=206).contains(&count(300)), "{}", count(300));
        // In the second move it goes back to 1000, and the touch at 2000 began in the move before.
        assert_eq!((count(1500), count(1899), count(1901), count(2050)), (3, 3, 1, 1));
        assert!((201..=206).contains(&count(1900)), "{}", count(1900));
        // Each touch costs the way back and forth, and the stop.
        let lost = 6000 - probe.clock;
        assert!((2 * 300 + 2 * 900 + 400..=2 * 300 + 2 * 900 + 412).contains(&lost), "{lost}");

        let mut touching = Probe::new(&timing());
        (0..5000).for_each(|_| touching.advance(true));
        assert_eq!(touching.clock, 5000, "what is touched from the start on is no touch");
    }

    #[test]
    fn a_course_is_linear_between_samples() {
        // A sample has 100 steps.
        let course = Setpoints::through(&[0.0, 1.0, 0.5, -1.0, 0.25, 3.0], 2, &timing());
        for (step, expected) in
            [(0, [0.0, 1.0]), (25, [0.125, 0.5]), (100, [0.5, -1.0]), (150, [0.375, 1.0]), (900, [0.25, 3.0])]
        {
            let mut setpoint = [0.0; 2];
            course.setpoint(step, &mut setpoint);
            assert_eq!(setpoint, expected, "{step}");
        }
    }

    #[test]
    fn walks_and_sinusoids_start_at_rest_and_stay_in_range() {
        let (spec, ranges, rest) = (Simulation::default(), [[-1.0, 2.0], [0.0, 1.5]], [0.5, 0.0]);
        for kind in [Motion::RandomWalk, Motion::Sinusoids] {
            for seed in 0..20 {
                let mut rng = ChaCha8Rng::seed_from_u64(seed);
                let motion = Setpoints::draw(kind, &ranges, &rest, &spec, &timing(), &mut rng);
                let setpoint = |step: usize| {
                    let mut setpoint = [0.0; 2];
                    motion.setpoint(step, &mut setpoint);
                    setpoint
                };
                assert_eq!(setpoint(0), rest);
                let (mut least, mut most) = (rest, rest);
                // Each move has 1000 steps, and the episode has 20 moves.
                for step in 0..20_000 {
                    let (here, next) = (setpoint(step), setpoint(step + 1));
                    for (joint, [low, high]) in ranges.into_iter().enumerate() {
                        assert!(
                            (low - 1e-12..=high + 1e-12).contains(&here[joint]),
                            "{kind:?} {seed} {step}"
                        );
                        // During the first move, the approach adds at most another move through the range.
                        let speed = if step < 1000 { 3.0 } else { 1.5 };
                        assert!((next[joint] - here[joint]).abs() <= speed * (high - low) / 1000.0);
                        least[joint] = least[joint].min(here[joint]);
                        most[joint] = most[joint].max(here[joint]);
                        if kind == Motion::RandomWalk && step.is_multiple_of(1000) {
                            let step = setpoint(step + 1000)[joint] - here[joint];
                            assert!(step.abs() <= 0.3 * (high - low) + 1e-12, "{step}");
                        }
                    }
                }
                // A sinusoid of the lowest frequency has two periods in the episode.
                for (joint, [low, high]) in ranges.into_iter().enumerate() {
                    assert!(most[joint] - least[joint] > 0.2 * (high - low), "{kind:?} {seed}");
                }
                assert_eq!(setpoint(20_000), setpoint(123_456));
            }
        }
    }
}
