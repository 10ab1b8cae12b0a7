//! How good a prediction is: metrics in physical units, and the simple baselines they are read against.
//!
//! [`series`] has the formulas, [`Evaluation`] applies those that suit a modality to its joints, links or
//! pixels, [`parts`] tells which pixels show the robot's parts, [`baselines`] predicts without a network,
//! [`contact`] sums up forces. Everything accumulates batch by batch in f64, so a test set of frames need not fit in
//! memory.

pub mod baselines;
pub mod contact;
mod error;
pub mod parts;
pub mod series;

pub use error::MetricsError;
use error::{check_finite, check_samples, rows};
pub use series::Series;

use crate::spec::{JOINTS, Modality};
use parts::Part;
use rayon::prelude::*;
use std::slice::from_ref;

/// Columns that a thread adds up at a time.
const COLUMNS_AT_ONCE: usize = 1024;

/// The axis a joint of the finger bends about; a link's direction is that of the joint at its base.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Direction {
    /// Joints 0, 2, 4, …
    FlexionExtension,
    /// Joints 1, 3, 5, …
    AdductionAbduction,
}

impl Direction {
    pub const ALL: [Direction; 2] = [Direction::FlexionExtension, Direction::AdductionAbduction];

    /// Direction of the finger's `joint`, counted from 0 at the base.
    pub fn of(joint: usize) -> Direction {
        Self::ALL[joint % 2]
    }

    /// The last joint, or link, of this direction.
    pub fn fingertip(self) -> usize {
        (0..JOINTS).rev().find(|joint| Direction::of(*joint) == self).unwrap_or_default()
    }

    /// The name in tables: the paper's subscripts.
    pub fn name(self) -> &'static str {
        match self {
            Direction::FlexionExtension => "fe",
            Direction::AdductionAbduction => "aa",
        }
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
    /// The same over the pixels that show the arm before or after the change, and not the finger.
    RelativeErrorArm,
    /// The same over the pixels that show the finger before or after the change.
    RelativeErrorFinger,
}

impl Metric {
    pub const ALL: [Metric; 8] = {
        use Metric::*;
        [Smape, Wmape, R2, Rmse, Mae, RelativeError, RelativeErrorArm, RelativeErrorFinger]
    };

    /// The metrics that a modality is judged by.
    pub fn of(modality: Modality) -> &'static [Metric] {
        use Metric::*;
        match modality {
            Modality::Proprioception => &[Smape, R2, Rmse, Mae],
            Modality::ContactForce | Modality::ContactForceMean => &[Wmape, R2, Rmse, Mae],
            Modality::Arm => &[R2, Rmse, Mae],
            Modality::Vision => &[RelativeError, Rmse, Mae],
            Modality::FrameDifference => &[RelativeError, RelativeErrorArm, RelativeErrorFinger, Rmse, Mae],
        }
    }

    /// The name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Metric::Smape => "smape",
            Metric::Wmape => "wmape",
            Metric::R2 => "r2",
            Metric::Rmse => "rmse",
            Metric::Mae => "mae",
            Metric::RelativeError => "relative_error",
            Metric::RelativeErrorArm => "relative_error_arm",
            Metric::RelativeErrorFinger => "relative_error_finger",
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
    /// In [`Row::unit`]; `None` where the metric isn't defined.
    pub value: Option<f64>,
}

impl Row {
    /// Unit of the value: "%", "1" (none), or the measured quantity's.
    pub fn unit(&self) -> &'static str {
        match self.metric {
            Metric::Smape | Metric::Wmape => "%",
            Metric::R2 | Metric::RelativeError | Metric::RelativeErrorArm | Metric::RelativeErrorFinger => {
                "1"
            }
            Metric::Rmse | Metric::Mae => match self.modality {
                Modality::Proprioception => "rad",
                Modality::Arm if self.index == Some(0) => "rad",
                Modality::Arm => "m",
                Modality::ContactForce | Modality::ContactForceMean => "N",
                Modality::Vision | Modality::FrameDifference => "1",
            },
        }
    }
}

/// Compares predictions of one modality with the reference, batch by batch.
///
/// Values are in physical units: rad, m, N; frames as intensities in [0, 1] and their differences in [-1, 1].
#[derive(Debug, Clone)]
pub struct Evaluation {
    modality: Modality,
    columns: Vec<Series>,
    /// Of the pixels that show each part.
    arm: Series,
    finger: Series,
}

impl Evaluation {
    pub fn new(modality: Modality) -> Self {
        let columns = vec![Series::default(); modality.width()];
        Self { modality, columns, arm: Series::default(), finger: Series::default() }
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

    /// Adds a batch of frames, with the part of the robot that each pixel shows: `[samples, pixels]`.
    ///
    /// # Errors
    /// As [`Evaluation::add`], or `parts` has another number of samples.
    pub fn add_with_parts(
        &mut self,
        reference: &[f32],
        predicted: &[f32],
        parts: &[Option<Part>],
    ) -> Result<(), MetricsError> {
        let width = self.columns.len();
        let parts = rows("the mask of parts", parts, parts::PIXELS)?;
        check_samples(("the reference", reference.len() / width), ("the mask of parts", parts.len()))?;
        self.add(reference, predicted)?;
        let frames = reference.chunks_exact(width).zip(predicted.chunks_exact(width));
        for ((reference, predicted), parts) in frames.zip(parts) {
            // Every channel has the same pixels.
            for ((&r, &p), part) in reference.iter().zip(predicted).zip(parts.iter().cycle()) {
                match part {
                    Some(Part::Arm) => self.arm.add(r, p),
                    Some(Part::Finger) => self.finger.add(r, p),
                    None => {}
                }
            }
        }
        Ok(())
    }

    /// The metrics so far: overall first, then by direction, then by joint or link.
    ///
    /// Joints and links of the finger have all three; the arm's joints differ in unit and are never pooled;
    /// frames are only pooled. Pooled values add the sums of their series, see [`series`].
    pub fn rows(&self) -> Vec<Row> {
        self.groups()
            .into_iter()
            .flat_map(|group| {
                Metric::of(self.modality).iter().map(move |&metric| Row {
                    modality: self.modality,
                    direction: group.direction,
                    index: group.index,
                    metric,
                    value: self.value(metric, &group.series),
                })
            })
            .collect()
    }

    /// A metric over `series`, pooled; `None` where it isn't defined.
    fn value(&self, metric: Metric, series: &[Series]) -> Option<f64> {
        match metric {
            Metric::Smape => series::smape(series),
            Metric::Wmape => series::wmape(series),
            Metric::R2 => series::r2(series),
            Metric::Rmse => series::rmse(series),
            Metric::Mae => series::mae(series),
            Metric::RelativeError if self.modality == Modality::FrameDifference => {
                series::error_relative_to_zero(series)
            }
            Metric::RelativeError => series::error_relative_to_mean(series),
            Metric::RelativeErrorArm => series::error_relative_to_zero(from_ref(&self.arm)),
            Metric::RelativeErrorFinger => series::error_relative_to_zero(from_ref(&self.finger)),
        }
    }

    fn groups(&self) -> Vec<Group> {
        let finger = is_finger(self.modality);
        let mut groups = Vec::new();
        if self.modality != Modality::Arm {
            groups.push(Group { direction: None, index: None, series: self.columns.clone() });
        }
        if finger {
            groups.extend(Direction::ALL.map(|direction| self.direction(direction)));
        }
        if finger || self.modality == Modality::Arm {
            groups.extend(self.columns.iter().enumerate().map(|(index, &series)| Group {
                direction: finger.then(|| Direction::of(index)),
                index: Some(index as u32),
                series: vec![series],
            }));
        }
        groups
    }

    fn direction(&self, direction: Direction) -> Group {
        let joints = self.columns.iter().enumerate().filter(|(joint, _)| Direction::of(*joint) == direction);
        Group { direction: Some(direction), index: None, series: joints.map(|(_, &series)| series).collect() }
    }
}

/// Series that make one number together.
struct Group {
    direction: Option<Direction>,
    index: Option<u32>,
    series: Vec<Series>,
}

/// The metrics of one modality over samples that fit in memory; see [`Evaluation`] for shapes, units, errors.
pub fn evaluate(modality: Modality, reference: &[f32], predicted: &[f32]) -> Result<Vec<Row>, MetricsError> {
    let mut evaluation = Evaluation::new(modality);
    evaluation.add(reference, predicted)?;
    Ok(evaluation.rows())
}

fn is_finger(modality: Modality) -> bool {
    matches!(modality, Modality::Proprioception | Modality::ContactForce | Modality::ContactForceMean)
}
