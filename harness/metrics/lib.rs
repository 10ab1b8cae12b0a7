//! How good a prediction is: metrics in physical units, and the simple baselines they are read against.
//!
//! [`series`] has the formulas, [`Evaluation`] applies those that suit a modality to its joints, links or
//! pixels, [`parts`] tells which pixels show the robot's parts, [`baselines`] predicts without a network,
//! [`contact`] sums up forces, [`epoch`] is what training logs. Everything accumulates batch by batch in f64, so a test set of frames need not fit in
//! memory.

pub mod baselines;
pub mod contact;
pub mod epoch;
mod error;
pub mod parts;
pub mod series;

pub use error::MetricsError;
use error::{check_finite, check_samples, rows};
pub use series::Series;

use harness_spec::{Definition, IMAGE_CHANNELS, Modality, Percentage, Region, intern};
use rayon::prelude::*;
use std::slice::from_ref;

const RELATIVE_ERROR: &str = "relative_error";

/// Columns that a thread adds up at a time.
const COLUMNS_AT_ONCE: usize = 1024;

/// A group of elements, by its name in the tables.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Direction(&'static str);

impl Direction {
    /// The finger's joints 0, 2, 4, …, and the links that they carry.
    pub const FLEXION_EXTENSION: Self = Self("fe");
    /// The finger's joints 1, 3, 5, …
    pub const ADDUCTION_ABDUCTION: Self = Self("aa");
    /// Those of the finger, which the paper's figures tell apart.
    pub const FINGER: [Self; 2] = [Self::FLEXION_EXTENSION, Self::ADDUCTION_ABDUCTION];

    /// The group of that name.
    pub fn new(name: &str) -> Self {
        Self(intern(name))
    }

    /// The name in tables: of the finger, the paper's subscripts.
    pub fn name(self) -> &'static str {
        self.0
    }

    /// The elements of a modality that belong to it.
    pub fn elements(self, definition: &Definition) -> &[usize] {
        definition.groups.iter().find(|group| group.name == self.0).map_or(&[], |group| &group.elements)
    }
}

/// What is measured; the formulas stand in [`series`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Metric {
    Smape,
    Wmape,
    R2,
    Rmse,
    Mae,
    /// Squared error relative to that of a trivial prediction; 1 is no better than it, 0 is perfect.
    /// `frame_difference` is compared with no change, `vision` with each pixel's own mean over the test
    /// samples, the best still picture there is.
    RelativeError,
    /// The same over the pixels that show a region before or after the change, by the metric's whole name.
    RelativeErrorOf(&'static str),
}

impl Metric {
    /// Those that no region has of its own.
    pub const GENERAL: [Metric; 6] = {
        use Metric::*;
        [Smape, Wmape, R2, Rmse, Mae, RelativeError]
    };

    /// The error of a region, relative to that of a trivial prediction.
    pub fn of_region(region: &str) -> Self {
        Self::RelativeErrorOf(intern(&format!("{RELATIVE_ERROR}_{region}")))
    }

    /// The metric of that name; `None` where there is none.
    pub fn named(name: &str) -> Option<Self> {
        let general = Self::GENERAL.into_iter().find(|metric| metric.name() == name);
        general.or_else(|| {
            let region = name.strip_prefix(RELATIVE_ERROR)?.strip_prefix('_')?;
            Modality::new(region).map(|_| Self::of_region(region))
        })
    }

    /// The metrics that a modality is judged by, where images have these regions.
    pub fn of(definition: &Definition, regions: &[Region]) -> Vec<Metric> {
        use Metric::*;
        if !definition.is_image() {
            let percentage = definition.percentage.map(|percentage| match percentage {
                Percentage::Smape => Smape,
                Percentage::Wmape => Wmape,
            });
            return percentage.into_iter().chain([R2, Rmse, Mae]).collect();
        }
        // The region of a pixel is that of a change.
        let regions = if definition.difference_of.is_some() { regions } else { &[] };
        let of_regions = regions.iter().map(|region| Self::of_region(&region.name));
        [RelativeError].into_iter().chain(of_regions).chain([Rmse, Mae]).collect()
    }

    /// The name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Metric::Smape => "smape",
            Metric::Wmape => "wmape",
            Metric::R2 => "r2",
            Metric::Rmse => "rmse",
            Metric::Mae => "mae",
            Metric::RelativeError => RELATIVE_ERROR,
            Metric::RelativeErrorOf(name) => name,
        }
    }
}

/// One number of the metrics table.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    pub modality: Modality,
    /// Of the one joint or link, or of all those pooled; `None` where no direction applies or both are pooled.
    pub direction: Option<Direction>,
    /// The joint or link, counted from 0 at the base; `None` where several are pooled.
    pub index: Option<u32>,
    pub metric: Metric,
    /// `None` where the metric isn't defined.
    pub value: Option<f64>,
    /// Unit of the value: "%", "1" (none), or the measured quantity's.
    pub unit: String,
}

/// Compares predictions of one modality with the reference, batch by batch.
///
/// Values are in physical units: rad, m, N; frames as intensities in [0, 1] and their differences in [-1, 1].
#[derive(Debug, Clone)]
pub struct Evaluation {
    definition: Definition,
    metrics: Vec<Metric>,
    columns: Vec<Series>,
    /// Of the pixels that show each region.
    regions: Vec<Series>,
}

impl Evaluation {
    /// Of a modality, in whose images these regions are told apart.
    pub fn new(definition: &Definition, regions: &[Region]) -> Self {
        Self {
            definition: definition.clone(),
            metrics: Metric::of(definition, regions),
            columns: vec![Series::default(); definition.width()],
            regions: vec![Series::default(); regions.len()],
        }
    }

    /// Adds a batch: `reference` and `predicted`, each row-major `[samples, width of the modality]`.
    ///
    /// # Errors
    /// The shapes differ or are no whole number of rows, or a value isn't finite; nothing is added then.
    pub fn add(&mut self, reference: &[f32], predicted: &[f32]) -> Result<(), MetricsError> {
        let width = self.columns.len();
        let references = rows("the reference", reference, width)?;
        let predictions = rows("the prediction", predicted, width)?;
        check_samples(("the reference", references.len()), ("the prediction", predictions.len()))?;
        check_finite("the reference", reference, width)?;
        check_finite("the prediction", predicted, width)?;
        // Each column adds up its own values in their order, whichever thread does it.
        self.columns.par_chunks_mut(COLUMNS_AT_ONCE).enumerate().for_each(|(chunk, columns)| {
            let first = chunk * COLUMNS_AT_ONCE;
            for (reference, predicted) in references.clone().zip(predictions.clone()) {
                let pairs = reference[first..].iter().zip(&predicted[first..]);
                columns.iter_mut().zip(pairs).for_each(|(series, (&r, &p))| series.add(r, p));
            }
        });
        Ok(())
    }

    /// Adds a batch of frames, with the region that each pixel shows, by its index: `[samples, pixels]`.
    ///
    /// # Errors
    /// As [`Evaluation::add`], or `parts` has another number of samples.
    pub fn add_with_regions(
        &mut self,
        reference: &[f32],
        predicted: &[f32],
        parts: &[Option<u8>],
    ) -> Result<(), MetricsError> {
        let width = self.columns.len();
        let parts = rows("the mask of regions", parts, width / IMAGE_CHANNELS)?;
        check_samples(("the reference", reference.len() / width), ("the mask of regions", parts.len()))?;
        self.add(reference, predicted)?;
        let frames = reference.chunks_exact(width).zip(predicted.chunks_exact(width));
        for ((reference, predicted), parts) in frames.zip(parts) {
            // Every channel has the same pixels.
            for ((&r, &p), part) in reference.iter().zip(predicted).zip(parts.iter().cycle()) {
                if let Some(region) = part {
                    self.regions[usize::from(*region)].add(r, p);
                }
            }
        }
        Ok(())
    }

    /// The metrics so far: overall first, then by group, then by element.
    ///
    /// Elements of different units are never pooled; images are only pooled. Pooled values add the sums of their series,
    /// see [`series`].
    pub fn rows(&self) -> Vec<Row> {
        let groups = self.groups();
        let rows = groups.iter().flat_map(|group| {
            self.metrics.iter().map(|&metric| Row {
                modality: self.definition.name,
                direction: group.direction,
                index: group.index,
                metric,
                value: self.value(metric, &group.series),
                unit: self.unit(metric, group.index),
            })
        });
        rows.collect()
    }

    fn unit(&self, metric: Metric, index: Option<u32>) -> String {
        match metric {
            Metric::Smape | Metric::Wmape => "%".into(),
            Metric::R2 | Metric::RelativeError | Metric::RelativeErrorOf(_) => "1".into(),
            Metric::Rmse | Metric::Mae => {
                let element = index.and_then(|index| self.definition.elements().get(index as usize));
                element
                    .map(|element| element.unit.as_str())
                    .or(self.definition.unit())
                    .unwrap_or_default()
                    .into()
            }
        }
    }

    /// A metric over `series`, pooled; `None` where it isn't defined.
    fn value(&self, metric: Metric, series: &[Series]) -> Option<f64> {
        match metric {
            Metric::Smape => series::smape(series),
            Metric::Wmape => series::wmape(series),
            Metric::R2 => series::r2(series),
            Metric::Rmse => series::rmse(series),
            Metric::Mae => series::mae(series),
            Metric::RelativeError if self.definition.difference_of.is_some() => {
                series::error_relative_to_zero(series)
            }
            Metric::RelativeError => series::error_relative_to_mean(series),
            Metric::RelativeErrorOf(_) => {
                let of_regions =
                    self.metrics.iter().filter(|other| matches!(other, Metric::RelativeErrorOf(_)));
                let region = of_regions.zip(&self.regions).find(|(other, _)| **other == metric);
                series::error_relative_to_zero(from_ref(region?.1))
            }
        }
    }

    fn groups(&self) -> Vec<Group> {
        let definition = &self.definition;
        let mut groups = Vec::new();
        if definition.unit().is_some() {
            groups.push(Group { direction: None, index: None, series: self.columns.clone() });
            groups.extend(definition.groups.iter().map(|group| Group {
                direction: Some(Direction::new(&group.name)),
                index: None,
                series: group.elements.iter().map(|element| self.columns[*element]).collect(),
            }));
        }
        if !definition.is_image() {
            groups.extend(self.columns.iter().enumerate().map(|(index, &series)| Group {
                direction: definition.group_of(index).map(|group| Direction::new(&group.name)),
                index: Some(index as u32),
                series: vec![series],
            }));
        }
        groups
    }
}

/// Series that make one number together.
struct Group {
    direction: Option<Direction>,
    index: Option<u32>,
    series: Vec<Series>,
}

/// The metrics of one modality over samples that fit in memory; see [`Evaluation`] for shapes, units, errors.
pub fn evaluate(
    definition: &Definition,
    reference: &[f32],
    predicted: &[f32],
) -> Result<Vec<Row>, MetricsError> {
    let mut evaluation = Evaluation::new(definition, &[]);
    evaluation.add(reference, predicted)?;
    Ok(evaluation.rows())
}
