//! What predicted probabilities of categories are worth.
//!
//! The predicted category is the one with the largest probability, or the first of several. For the log loss,
//! probabilities below [`LEAST`] count as it, and are divided by their sum, so that a regression has a log loss too.

use super::series::ratio;
use super::{Direction, EpisodeSums, Metric, Row};
use harness_spec::Definition;

/// The least probability in the log loss, which would otherwise be infinite. It is the relative precision of 32-bit
/// numbers, as in scikit-learn's `log_loss` of such numbers.
pub const LEAST: f64 = f32::EPSILON as f64;

/// Compares predicted probabilities with the categories of samples, batch by batch.
#[derive(Debug, Clone)]
pub(super) struct Categories {
    definition: Definition,
    /// Number of samples by their category and the predicted one, `[categories, categories]`.
    confusion: Vec<u64>,
    /// The sum of the log loss, nats.
    log_loss: f64,
    /// Each episode that has ended, with its samples, those of them that are right, and its log loss.
    episodes: Vec<(u32, [f64; 3])>,
}

impl Categories {
    pub fn new(definition: &Definition) -> Self {
        let confusion = vec![0; definition.width() * definition.width()];
        Self { definition: definition.clone(), confusion, log_loss: 0.0, episodes: Vec::new() }
    }

    /// Adds a batch of finite values, `[samples, categories]` each.
    pub fn add(&mut self, reference: &[f32], predicted: &[f32]) {
        let width = self.definition.width();
        for (reference, predicted) in reference.chunks_exact(width).zip(predicted.chunks_exact(width)) {
            let category = largest(reference);
            self.confusion[category * width + largest(predicted)] += 1;
            let bounded = |value: &f32| f64::from(*value).max(LEAST);
            let sum: f64 = predicted.iter().map(bounded).sum();
            self.log_loss -= (bounded(&predicted[category]) / sum).ln();
        }
    }

    /// Ends an episode, or a part of it: what was added since the last call is of this episode.
    pub fn end_episode(&mut self, episode: u32) {
        let before = self.episodes.iter().fold([0.0; 3], |all, (_, own)| [0, 1, 2].map(|i| all[i] + own[i]));
        let [samples, right] = self.counts(0..self.definition.width());
        let now = [samples, right, self.log_loss];
        let own = [0, 1, 2].map(|i| now[i] - before[i]);
        match self.episodes.last_mut() {
            Some((last, all)) if *last == episode => {
                all.iter_mut().zip(own).for_each(|(sum, own)| *sum += own)
            }
            _ => self.episodes.push((episode, own)),
        }
    }

    /// Returns the accuracy and the log loss of each episode that has ended, as sums.
    pub fn sums(&self) -> Vec<EpisodeSums> {
        let of = |(metric, place): (Metric, usize)| {
            self.episodes.iter().map(move |(episode, own)| EpisodeSums {
                modality: self.definition.name,
                direction: None,
                metric,
                episode: *episode,
                numerator: own[place],
                denominator: own[0],
            })
        };
        [(Metric::Accuracy, 1), (Metric::LogLoss, 2)].into_iter().flat_map(of).collect()
    }

    /// Returns the metrics of all categories together, the accuracy of each, and the number of samples of each pair of a
    /// category and a predicted one that occurs.
    pub fn rows(&self) -> Vec<Row> {
        let width = self.definition.width();
        let [samples, right] = self.counts(0..width);
        let shares: Vec<Option<f64>> = (0..width).map(|category| self.accuracy(category)).collect();
        let there: Vec<f64> = shares.iter().copied().flatten().collect();
        let whole = [
            (Metric::Accuracy, ratio(right, samples), "1"),
            (Metric::BalancedAccuracy, ratio(there.iter().sum(), there.len() as f64), "1"),
            (Metric::LogLoss, ratio(self.log_loss, samples), "nats"),
        ];
        let mut rows: Vec<Row> = whole
            .into_iter()
            .map(|(metric, value, unit)| self.row(metric, None, None, value, unit))
            .collect();
        let each = shares.iter().enumerate();
        rows.extend(each.map(|(category, share)| {
            let name = self.name(category).to_owned();
            self.row(Metric::Accuracy, Some(name), Some(category), *share, "1")
        }));
        let counts = self.confusion.iter().enumerate().filter(|(_, count)| **count > 0);
        rows.extend(counts.map(|(place, count)| {
            let (category, predicted) = (place / width, place % width);
            let pair = format!("{} as {}", self.name(category), self.name(predicted));
            self.row(Metric::Confusion, Some(pair), Some(category), Some(*count as f64), "samples")
        }));
        rows
    }

    /// The number of samples of some categories, and of those of them that are predicted right.
    fn counts(&self, categories: std::ops::Range<usize>) -> [f64; 2] {
        let width = self.definition.width();
        let of = |category: usize| {
            let own = &self.confusion[category * width..][..width];
            [own.iter().sum::<u64>(), own[category]]
        };
        let all = categories.map(of).fold([0, 0], |all, own| [all[0] + own[0], all[1] + own[1]]);
        all.map(|count| count as f64)
    }

    /// The share of the samples of a category that are predicted right; `None` without any.
    fn accuracy(&self, category: usize) -> Option<f64> {
        let [samples, right] = self.counts(category..category + 1);
        ratio(right, samples)
    }

    fn name(&self, category: usize) -> &str {
        &self.definition.elements()[category].name
    }

    fn row(
        &self,
        metric: Metric,
        direction: Option<String>,
        category: Option<usize>,
        value: Option<f64>,
        unit: &str,
    ) -> Row {
        Row {
            modality: self.definition.name,
            direction: direction.map(|name| Direction::new(&name)),
            index: category.map(|category| category as u32),
            metric,
            value,
            unit: unit.to_owned(),
        }
    }
}

/// The position of the largest value, or of the first of several.
fn largest(values: &[f32]) -> usize {
    let later = |best: usize, place: usize| if values[place] > values[best] { place } else { best };
    (0..values.len()).fold(0, later)
}
