//! How far predicted directions in space are from the true ones.

use super::series::ratio;
use super::{Direction, EpisodeSums, Metric, Row};
use harness_spec::{AXES, Definition};
use std::f64::consts::FRAC_PI_2;

/// Compares predicted vectors with unit vectors, batch by batch. Where the reference is all 0, there is no direction,
/// and nothing is compared.
#[derive(Debug, Clone)]
pub(super) struct Angles {
    definition: Definition,
    /// The angles of each unit vector: their sum, rad, and their number.
    sums: Vec<[f64; 2]>,
    /// Each episode that has ended, with its own sum and number.
    episodes: Vec<(u32, [f64; 2])>,
}

impl Angles {
    pub fn new(definition: &Definition) -> Self {
        let sums = vec![[0.0; 2]; definition.width() / AXES];
        Self { definition: definition.clone(), sums, episodes: Vec::new() }
    }

    /// Adds a batch of finite values, `[samples, width of the modality]` each.
    pub fn add(&mut self, reference: &[f32], predicted: &[f32]) {
        let places = (0..self.sums.len()).cycle();
        let pairs = reference.chunks_exact(AXES).zip(predicted.chunks_exact(AXES));
        for (place, (reference, predicted)) in places.zip(pairs) {
            if let Some(angle) = angle(reference, predicted) {
                let [sum, count] = &mut self.sums[place];
                (*sum, *count) = (*sum + angle, *count + 1.0);
            }
        }
    }

    /// Ends an episode, or a part of it: what was added since the last call is of this episode.
    pub fn end_episode(&mut self, episode: u32) {
        let before = total(self.episodes.iter().map(|(_, own)| *own));
        let now = total(self.sums.iter().copied());
        let own = [now[0] - before[0], now[1] - before[1]];
        match self.episodes.last_mut() {
            Some((last, all)) if *last == episode => *all = total([*all, own]),
            _ => self.episodes.push((episode, own)),
        }
    }

    /// Returns the angle in each episode that has ended, as sums.
    pub fn sums(&self) -> Vec<EpisodeSums> {
        let of = |(episode, [numerator, denominator]): &(u32, [f64; 2])| EpisodeSums {
            modality: self.definition.name,
            direction: None,
            metric: Metric::Angle,
            episode: *episode,
            numerator: *numerator,
            denominator: *denominator,
        };
        self.episodes.iter().map(of).collect()
    }

    /// Returns the mean angle of all unit vectors, that of each group's, and that of each, whose index is that of its
    /// first element.
    pub fn rows(&self) -> Vec<Row> {
        let row = |direction: Option<Direction>, index: Option<usize>, [sum, count]: [f64; 2]| Row {
            modality: self.definition.name,
            direction,
            index: index.map(|index| index as u32),
            metric: Metric::Angle,
            value: ratio(sum, count),
            unit: "rad".to_owned(),
        };
        let of = |elements: &[usize]| {
            let firsts = elements.iter().filter(|element| *element % AXES == 0);
            total(firsts.map(|first| self.sums[first / AXES]))
        };
        let all: Vec<usize> = (0..self.definition.width()).collect();
        let groups = self.definition.groups.iter();
        let groups = groups.map(|group| row(Some(Direction::new(&group.name)), None, of(&group.elements)));
        let each = all.iter().step_by(AXES).map(|first| {
            let direction = self.definition.group_of(*first).map(|group| Direction::new(&group.name));
            row(direction, Some(*first), of(&[*first]))
        });
        std::iter::once(row(None, None, of(&all))).chain(groups).chain(each).collect()
    }
}

/// The angle between two vectors, rad: a right angle if the prediction has no direction. `None` if the reference has
/// none.
fn angle(reference: &[f32], predicted: &[f32]) -> Option<f64> {
    let product =
        |a: &[f32], b: &[f32]| -> f64 { a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum() };
    let lengths = (product(reference, reference) * product(predicted, predicted)).sqrt();
    match reference.iter().all(|value| *value == 0.0) {
        true => None,
        false if lengths == 0.0 => Some(FRAC_PI_2),
        false => Some((product(reference, predicted) / lengths).clamp(-1.0, 1.0).acos()),
    }
}

fn total(sums: impl IntoIterator<Item = [f64; 2]>) -> [f64; 2] {
    sums.into_iter().fold([0.0; 2], |all, own| [all[0] + own[0], all[1] + own[1]])
}
