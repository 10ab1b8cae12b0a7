//! The quality of a prediction: metrics in physical units, and simple baselines to compare them with.
//!
//! [`series`] has the formulas. [`Evaluation`] applies those that suit a modality to its joints, links or pixels.
//! [`parts`] finds the pixels that show parts of the robot. [`baselines`] predicts without a network. [`contact`]
//! summarizes forces. [`force`] judges their predictions, and [`ensemble`] is a predictive distribution. [`skill`] compares with persistence, horizon by horizon. [`latent`] says how much of a latent
//! state is used. [`epoch`] is what training logs. `words`
//! has names and values for people.
//!
//! [`category`] judges categories.
//!
//! Everything accumulates batch by batch in f64, so a test set of frames need not fit in memory.

pub mod angle;
pub mod baselines;
pub mod category;
pub mod contact;
pub mod ensemble;
pub mod epoch;
mod error;
pub mod force;
pub mod latent;
pub mod parts;
pub mod series;
pub mod skill;
mod words;

use angle::Angles;
use category::Categories;
pub use ensemble::{Ensemble, Members};
pub use error::MetricsError;
use error::{check_finite, check_samples, rows};
pub use force::{ForceEvaluation, Forces};
pub use series::Series;
use series::smallest_mean_square;
pub use words::{best, higher_is_better, label, rounded};

use harness_spec::{Definition, IMAGE_CHANNELS, Modality, NO_CONTACT, Percentage, intern};
use rayon::prelude::*;
use std::collections::HashMap;
use std::str::FromStr;

/// Number of columns that a thread sums at a time.
const COLUMNS_AT_ONCE: usize = 1024;

/// The name of a group of elements in the tables.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Direction(&'static str);

impl Direction {
    /// The finger's joints 0, 2, 4, …, and the links that they move.
    pub const FLEXION_EXTENSION: Self = Self("fe");
    /// The finger's joints 1, 3, 5, …
    pub const ADDUCTION_ABDUCTION: Self = Self("aa");
    /// The groups of the finger, which the paper's figures distinguish.
    pub const FINGER: [Self; 2] = [Self::FLEXION_EXTENSION, Self::ADDUCTION_ABDUCTION];

    /// Returns the group with this name.
    pub fn new(name: &str) -> Self {
        Self(intern(name))
    }

    /// Returns the name for all elements with this unit, of a modality whose elements have different units. Names of
    /// other groups contain no space.
    fn in_unit(unit: &str) -> Self {
        Self::new(&format!("in {}", if unit.is_empty() { "no unit" } else { unit }))
    }

    /// Returns the name in tables. For the finger it is the paper's subscript.
    pub fn name(self) -> &'static str {
        self.0
    }

    /// Returns the indices of a modality's elements that belong to the group.
    pub fn elements(self, definition: &Definition) -> &[usize] {
        definition.groups.iter().find(|group| group.name == self.0).map_or(&[], |group| &group.elements)
    }
}

/// A metric. Its formula is in [`series`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Metric {
    /// Symmetric mean absolute percentage error, in %.
    Smape,
    /// Weighted mean absolute percentage error, in %.
    Wmape,
    /// Coefficient of determination.
    R2,
    /// Root mean squared error, in the unit of the values.
    Rmse,
    /// Mean absolute error, in the unit of the values.
    Mae,
    /// Squared error relative to that of a trivial prediction: 0 is perfect, and 1 is no better than the trivial
    /// prediction. An image difference is compared with no change. Other images are compared with the mean of each
    /// pixel over the test samples, which is the best constant image.
    RelativeError,
    /// Skill score: 1 minus the mean squared error relative to that of persistence; see [`skill::skill`].
    Skill,
    /// The largest horizon up to which the skill is positive, in samples; see [`skill::skill_horizon`].
    SkillHorizon,
    /// The divergence of the latent state from what was expected before the present sample, in nats; see [`latent`].
    Kl,
    /// Number of dimensions of the latent state that are active; see [`latent`].
    Active,
    /// R2 of ln(1 + force), over the samples with a contact; see [`force`].
    LogR2,
    /// R2 without the 1 % of the samples whose reference is farthest from its mean; see [`force`].
    TrimmedR2,
    /// F1 of contacts; see [`force`].
    F1,
    /// Area under the ROC curve of contacts; see [`force`].
    Auc,
    /// Share of the samples whose category has the largest predicted probability; see [`category`].
    Accuracy,
    /// Mean over the categories of the share of their samples that are predicted right; see [`category`].
    BalancedAccuracy,
    /// Mean cross-entropy of the predicted probabilities, in nats; see [`category`].
    LogLoss,
    /// Number of samples of a category that are predicted as a category; see [`category`].
    Confusion,
    /// Mean angle between predicted and true unit vectors, in rad; see [`angle`].
    Angle,
    /// Continuous ranked probability score, in the unit of the values; see [`ensemble`].
    Crps,
    /// Share of the references in the central interval with this probability in percent.
    Coverage(u8),
    /// Mean width of the central interval with this probability in percent, in the unit of the values.
    Width(u8),
    /// Share of the PIT values in this tenth of their range, counted from 0.
    Pit(u8),
    /// Another metric over a region: over the pixels that show the region before or after the change, over the
    /// contacts of one kind or in one phase, or over the samples from a time of their episode on. It holds the other metric and the
    /// whole name, such as `r2_ground`.
    Regional(&'static Metric, &'static str),
}

impl Metric {
    /// The metrics that no table has, because they follow from the RMSE of a model and that of persistence.
    pub const DERIVED: [Metric; 2] = [Metric::Skill, Metric::SkillHorizon];

    /// The metrics of a latent state. Neither higher nor lower values are better.
    pub const LATENT: [Metric; 2] = [Metric::Kl, Metric::Active];

    /// The metrics of the tables that judge predictions and do not belong to a region.
    pub const GENERAL: [Metric; 6] = {
        use Metric::*;
        [Smape, Wmape, R2, Rmse, Mae, RelativeError]
    };

    /// The metrics of forces that the strongest contacts do not decide.
    pub const FORCE: [Metric; 4] = [Metric::LogR2, Metric::TrimmedR2, Metric::F1, Metric::Auc];

    /// The metrics of categories.
    pub const CATEGORY: [Metric; 4] =
        [Metric::Accuracy, Metric::BalancedAccuracy, Metric::LogLoss, Metric::Confusion];

    /// The metrics of unit vectors.
    pub const UNIT_VECTORS: [Metric; 1] = [Metric::Angle];

    /// The metrics of a predictive distribution of forces.
    pub const DISTRIBUTION: [Metric; 15] = {
        use Metric::*;
        let [half, most] = force::INTERVALS;
        [
            Crps,
            Coverage(half),
            Coverage(most),
            Width(half),
            Width(most),
            Pit(0),
            Pit(1),
            Pit(2),
            Pit(3),
            Pit(4),
            Pit(5),
            Pit(6),
            Pit(7),
            Pit(8),
            Pit(9),
        ]
    };

    /// Returns all metrics that do not belong to a region.
    pub fn all() -> impl Iterator<Item = Metric> {
        let of_forces = Self::FORCE.into_iter().chain(Self::DISTRIBUTION);
        let general = Self::GENERAL.into_iter().chain(Self::DERIVED).chain(Self::LATENT);
        general.chain(of_forces).chain(Self::CATEGORY).chain(Self::UNIT_VECTORS)
    }

    /// Says in words which metrics there are.
    pub fn known() -> String {
        let names = Self::all().map(Self::name).collect::<Vec<_>>().join(", ");
        format!(
            "the metrics are {names}, relative_error_REGION of a world's regions, as relative_error_finger, METRIC_KIND \
             of its kinds of contact, as r2_ground, METRIC_PHASE of a contact, as crps_onset, and METRIC_from_Ns of \
             window.since_s, as r2_from_10s"
        )
    }

    /// Returns the metrics that can belong to a region.
    fn of_regions() -> impl Iterator<Item = &'static Metric> {
        Self::GENERAL.iter().chain(&Self::DISTRIBUTION).chain(&Self::CATEGORY).chain(&Self::UNIT_VECTORS)
    }

    /// Returns the place of a metric by its name: those of all modalities in their order, and after them all others.
    pub fn place(name: &str) -> usize {
        Self::all().position(|metric| metric.name() == name).unwrap_or(usize::MAX)
    }

    /// Returns this metric over the region with this name. A metric of a region has no regions itself.
    pub fn in_region(self, region: &str) -> Self {
        match Self::of_regions().find(|general| **general == self) {
            Some(general) => Self::Regional(general, intern(&format!("{}_{region}", self.name()))),
            None => self,
        }
    }

    /// Returns the metric with this name, if there is one.
    pub fn named(name: &str) -> Option<Self> {
        Self::all().find(|metric| metric.name() == name).or_else(|| {
            let regional = |metric: Self| {
                let region = name.strip_prefix(metric.name())?.strip_prefix('_')?;
                Modality::new(region).map(|_| metric.in_region(region))
            };
            Self::of_regions().copied().find_map(regional)
        })
    }

    /// Returns the metrics of a modality over all its values. Those of categories and of unit vectors are not computed
    /// from errors.
    pub fn of(definition: &Definition) -> Vec<Metric> {
        use Metric::*;
        if definition.has_own_loss() {
            return Vec::new();
        }
        if definition.is_image() {
            return vec![RelativeError, Rmse, Mae];
        }
        let percentage = definition.percentage.map(|percentage| match percentage {
            Percentage::Smape => Smape,
            Percentage::Wmape => Wmape,
        });
        percentage.into_iter().chain([R2, Rmse, Mae]).collect()
    }

    /// Returns the metric, given the numerator and the denominator that [`series::sums`] defines; `None` if the
    /// denominator is 0.
    pub fn of_sums(self, [numerator, denominator]: [f64; 2]) -> Option<f64> {
        let ratio = (denominator > 0.0).then(|| numerator / denominator)?;
        Some(match self {
            Metric::Regional(metric, _) => return metric.of_sums([numerator, denominator]),
            Metric::R2 => 1.0 - ratio,
            Metric::Smape | Metric::Wmape => 100.0 * ratio,
            Metric::Rmse => ratio.sqrt(),
            _ => ratio,
        })
    }

    /// Whether one value is better than another. It is not for a latent state, and not for the shape of a
    /// distribution, whose coverage should be as promised.
    pub fn is_judgment(self) -> bool {
        match self {
            Metric::Regional(metric, _) => metric.is_judgment(),
            Metric::Coverage(_) | Metric::Width(_) | Metric::Pit(_) | Metric::Confusion => false,
            metric => !Self::LATENT.contains(&metric),
        }
    }

    /// Whether higher values are better. All other metrics that are judgments are errors.
    pub fn higher_is_better(self) -> bool {
        match self {
            Metric::Regional(metric, _) => metric.higher_is_better(),
            Metric::R2 | Metric::Skill | Metric::SkillHorizon => true,
            Metric::Accuracy | Metric::BalancedAccuracy => true,
            metric => Self::FORCE.contains(&metric),
        }
    }

    /// Returns the name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Metric::Smape => "smape",
            Metric::Wmape => "wmape",
            Metric::R2 => "r2",
            Metric::Rmse => "rmse",
            Metric::Mae => "mae",
            Metric::RelativeError => "relative_error",
            Metric::Skill => "skill",
            Metric::SkillHorizon => "skill_horizon",
            Metric::Kl => "kl",
            Metric::Active => "active",
            Metric::LogR2 => "log_r2",
            Metric::TrimmedR2 => "trimmed_r2",
            Metric::F1 => "f1",
            Metric::Auc => "auc",
            Metric::Accuracy => "accuracy",
            Metric::BalancedAccuracy => "balanced_accuracy",
            Metric::LogLoss => "log_loss",
            Metric::Confusion => "confusion",
            Metric::Angle => "angle",
            Metric::Crps => "crps",
            Metric::Coverage(percent) => intern(&format!("coverage_{percent}")),
            Metric::Width(percent) => intern(&format!("width_{percent}")),
            Metric::Pit(bin) => intern(&format!("pit_{bin}")),
            Metric::Regional(_, name) => name,
        }
    }
}

impl FromStr for Metric {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        Self::named(name).ok_or_else(Self::known)
    }
}

/// One row of the metrics table.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// The modality that is predicted.
    pub modality: Modality,
    /// Group of the joint or link, or of all that are pooled; `None` if there is no group or all groups are pooled.
    pub direction: Option<Direction>,
    /// Index of the joint or link, counted from 0 at the base; `None` if several are pooled.
    pub index: Option<u32>,
    /// The metric.
    pub metric: Metric,
    /// The value of the metric; `None` if it isn't defined.
    pub value: Option<f64>,
    /// Unit of the value: "%", "1" for no unit, or the unit of the modality.
    pub unit: String,
}

/// What is predicted in two ways, row-major `[samples, width]`: the mean, which squared errors ask for, and the median,
/// which absolute errors ask for. A prediction without a distribution is both.
#[derive(Debug, Clone, Copy)]
pub struct Points<'a> {
    /// The means.
    pub mean: &'a [f32],
    /// The medians.
    pub median: &'a [f32],
}

impl<'a, T: AsRef<[f32]> + ?Sized> From<&'a T> for Points<'a> {
    fn from(values: &'a T) -> Self {
        Self { mean: values.as_ref(), median: values.as_ref() }
    }
}

impl<'a> Points<'a> {
    /// Returns the part with these values.
    pub fn part(self, values: std::ops::Range<usize>) -> Self {
        Self { mean: &self.mean[values.clone()], median: &self.median[values] }
    }
}

/// Returns the unit of a metric of some elements that does not belong to a region.
fn metric_unit(definition: &Definition, metric: Metric, elements: &[usize]) -> String {
    match metric {
        Metric::Smape | Metric::Wmape => "%".into(),
        Metric::Rmse | Metric::Mae | Metric::Crps | Metric::Width(_) => {
            definition.unit_of(elements).unwrap_or_default().into()
        }
        _ => "1".into(),
    }
}

/// Compares predictions of one modality with the reference, batch by batch.
///
/// Values are in physical units: rad, m, N. Images are intensities in [0, 1], and their differences are in [-1, 1].
///
/// A region is a part of the values that has metrics of its own: the pixels that show a region of a camera's image, or
/// the contacts of one kind, among which `none` is the absence of a contact.
#[derive(Debug, Clone)]
pub struct Evaluation {
    definition: Definition,
    /// What is known of categories; `None` for other modalities.
    categories: Option<Categories>,
    /// What unit vectors are judged by.
    angles: Option<Angles>,
    columns: Vec<Series>,
    regions: Vec<RegionSums>,
    episodes: Vec<Totals>,
}

/// The sums at the end of an episode, of all episodes so far.
#[derive(Debug, Clone)]
struct Totals {
    episode: u32,
    /// One series for each element of a vector, or one for all values of an image.
    columns: Vec<Series>,
    regions: Vec<Vec<Series>>,
}

/// The sums of a test episode from which a metric is computed, see [`Metric::of_sums`]. Their sums over all episodes
/// give the metric of the whole test.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeSums {
    /// The modality that is predicted.
    pub modality: Modality,
    /// The unit of the elements, if the modality has elements of different units.
    pub direction: Option<Direction>,
    /// The metric.
    pub metric: Metric,
    /// The episode of the dataset.
    pub episode: u32,
    /// The episode's part of the numerator.
    pub numerator: f64,
    /// The episode's part of the denominator.
    pub denominator: f64,
}

/// Sums over the values in a region.
#[derive(Debug, Clone)]
struct RegionSums {
    name: String,
    /// One series for each element of a vector, or one for all values of an image.
    series: Vec<Series>,
}

impl Evaluation {
    /// Creates an evaluation of a modality. `regions` are the names of the regions of its images.
    pub fn new(definition: &Definition, regions: &[String]) -> Self {
        // Regions of images are only defined for changes of a camera's image.
        let is_change = definition.difference_of.is_some() && !definition.is_coded();
        let of_image = regions.iter().filter(|_| definition.is_image() && is_change);
        let width = if definition.is_image() { 1 } else { definition.width() };
        let region =
            |name: &String| RegionSums { name: name.clone(), series: vec![Series::default(); width] };
        Self {
            definition: definition.clone(),
            categories: definition.category.then(|| Categories::new(definition)),
            angles: definition.unit_vectors.then(|| Angles::new(definition)),
            columns: vec![Series::default(); definition.width()],
            regions: of_image
                .cloned()
                .chain(definition.contact_regions())
                .map(|name| region(&name))
                .collect(),
            episodes: Vec::new(),
        }
    }

    /// Returns whether the modality's metrics need the region of each pixel or contact.
    pub fn has_regions(&self) -> bool {
        !self.regions.is_empty()
    }

    /// Adds a batch. `reference` and `predicted` are row-major `[samples, width of the modality]`.
    ///
    /// # Errors
    /// When the shapes differ or are not a whole number of rows, or a value isn't finite. Nothing is added in that
    /// case.
    pub fn add<'a>(
        &mut self,
        reference: &[f32],
        predicted: impl Into<Points<'a>>,
    ) -> Result<(), MetricsError> {
        let width = self.columns.len();
        let Points { mean, median } = predicted.into();
        let references = rows("the reference", reference, width)?;
        let means = rows("the prediction", mean, width)?;
        let medians = rows("the median", median, width)?;
        check_samples(("the reference", references.len()), ("the prediction", means.len()))?;
        check_samples(("the reference", references.len()), ("the median", medians.len()))?;
        check_finite("the reference", reference, width)?;
        check_finite("the prediction", mean, width)?;
        check_finite("the median", median, width)?;
        if let Some(categories) = &mut self.categories {
            categories.add(reference, mean);
        }
        if let Some(angles) = &mut self.angles {
            angles.add(reference, mean);
        }
        // Each column adds its values in their order, so the result does not depend on the threads.
        self.columns.par_chunks_mut(COLUMNS_AT_ONCE).enumerate().for_each(|(chunk, columns)| {
            let first = chunk * COLUMNS_AT_ONCE;
            for (reference, (mean, median)) in references.clone().zip(means.clone().zip(medians.clone())) {
                let points = mean[first..].iter().zip(&median[first..]);
                let pairs = columns.iter_mut().zip(&reference[first..]).zip(points);
                pairs.for_each(|((series, &r), (&mean, &median))| series.add_points(r, mean, median));
            }
        });
        Ok(())
    }

    /// Adds a batch with regions. `parts` has the index of the region of each element, or of each pixel of an image,
    /// which all its channels share: `[samples, elements]` or `[samples, pixels]`.
    pub fn add_with_regions<'a>(
        &mut self,
        reference: &[f32],
        predicted: impl Into<Points<'a>>,
        parts: &[Option<u8>],
    ) -> Result<(), MetricsError> {
        let width = self.columns.len();
        let (is_image, channels) =
            (self.definition.is_image(), if self.definition.is_image() { IMAGE_CHANNELS } else { 1 });
        let parts = rows("the mask of regions", parts, width / channels)?;
        check_samples(("the reference", reference.len() / width), ("the mask of regions", parts.len()))?;
        let points = predicted.into();
        self.add(reference, points)?;
        let points = points.mean.chunks_exact(width).zip(points.median.chunks_exact(width));
        for ((reference, (mean, median)), parts) in reference.chunks_exact(width).zip(points).zip(parts) {
            let values = reference.iter().zip(mean.iter().zip(median)).zip(parts.iter().cycle());
            for (element, ((&r, (&mean, &median)), part)) in values.enumerate() {
                if let Some(region) = part {
                    let series = &mut self.regions[usize::from(*region)].series;
                    series[if is_image { 0 } else { element }].add_points(r, mean, median);
                }
            }
        }
        Ok(())
    }

    /// Returns the metrics of all batches so far: of all elements first, then of each group, then of each element.
    ///
    /// Elements of different units are not pooled: all elements with the same unit are a group, and a group of the
    /// definition whose elements have different units is left out. Images have only pooled values, and regions as well.
    /// A pooled value is computed from the added sums of its series, see [`series`].
    pub fn rows(&self) -> Vec<Row> {
        if let Some(categories) = &self.categories {
            return categories.rows();
        }
        if let Some(angles) = &self.angles {
            return angles.rows();
        }
        let metrics = Metric::of(&self.definition);
        let mean_squares = self.mean_squares();
        let mut found = Vec::new();
        for Group { direction, index, elements } in self.groups() {
            let mut add = |metric: Metric, base: Metric, series: &[Series]| {
                let (modality, value) = (self.definition.name, series::value(base, self.is_change(), series));
                found.push(Row {
                    modality,
                    direction,
                    index,
                    metric,
                    value,
                    unit: metric_unit(&self.definition, base, &elements),
                });
            };
            let mean_square = mean_squares[&self.definition.unit_of(&elements)];
            let all = elements.iter().map(|element| self.columns[*element].without_round_off(mean_square));
            let all: Vec<Series> = all.collect();
            let regions: Vec<(&str, Vec<Series>)> = self
                .regions
                .iter()
                .filter(|_| index.is_none())
                .map(|region| (region.name.as_str(), self.pooled(region, &elements, mean_square)))
                .collect();
            for metric in &metrics {
                add(*metric, *metric, &all);
                for (name, series) in regions.iter().filter(|(name, _)| self.is_defined_in(name, *metric)) {
                    add(metric.in_region(name), *metric, series);
                }
            }
        }
        found
    }

    /// Returns the metrics of all batches so far as those of a region: of all elements first, then of each group. All
    /// added values are in this region, and the evaluation's own regions are left out.
    pub fn rows_of_region(&self, region: &str) -> Vec<Row> {
        let mut rows = self.rows();
        rows.retain(|row| row.index.is_none() && !matches!(row.metric, Metric::Regional(..)));
        rows.iter_mut().for_each(|row| row.metric = row.metric.in_region(region));
        rows
    }

    /// Whether a metric has a row for a region. Images have only the relative error, and forces without a contact are
    /// zero, so that only the absolute errors are defined.
    fn is_defined_in(&self, region: &str, metric: Metric) -> bool {
        match self.definition.is_image() {
            true => metric == Metric::RelativeError,
            false => region != NO_CONTACT || matches!(metric, Metric::Rmse | Metric::Mae),
        }
    }

    /// Returns the sums of a region over some elements, without round-off in a modality of this mean square.
    fn pooled(&self, region: &RegionSums, elements: &[usize], mean_square: f64) -> Vec<Series> {
        match self.definition.is_image() {
            true => region.series.clone(),
            false => {
                let series = elements.iter().map(|element| region.series[*element]);
                series.map(|series| series.without_round_off(mean_square)).collect()
            }
        }
    }

    /// Returns the largest mean square of the references of the elements with each unit, or of what they are computed with.
    fn mean_squares(&self) -> HashMap<Option<&str>, f64> {
        let mut largest = HashMap::new();
        for (element, series) in self.columns.iter().enumerate() {
            let unit = self.definition.unit_of(&[element]);
            let own = largest.entry(unit).or_insert_with(|| smallest_mean_square(unit));
            *own = f64::max(*own, series.mean_square());
        }
        largest
    }

    fn is_change(&self) -> bool {
        self.definition.difference_of.is_some()
    }

    /// Ends an episode, or a part of it: what was added since the last call is of this episode.
    pub fn end_episode(&mut self, episode: u32) {
        if let Some(categories) = &mut self.categories {
            return categories.end_episode(episode);
        }
        if let Some(angles) = &mut self.angles {
            return angles.end_episode(episode);
        }
        if self.episodes.last().is_some_and(|last| last.episode == episode) {
            self.episodes.pop();
        }
        let columns = match self.definition.is_image() {
            true => vec![Series::total(&self.columns)],
            false => self.columns.clone(),
        };
        let regions = self.regions.iter().map(|region| region.series.clone()).collect();
        self.episodes.push(Totals { episode, columns, regions });
    }

    /// Returns the sums of each episode that has ended, for the metrics of all elements, or of all with the same unit,
    /// and for R2 and the relative error of each region. The relative error of an image that is no change is left out.
    pub fn sums(&self) -> Vec<EpisodeSums> {
        if let Some(categories) = &self.categories {
            return categories.sums();
        }
        if let Some(angles) = &self.angles {
            return angles.sums();
        }
        let mean_squares = self.mean_squares();
        let mut found = Vec::new();
        for Group { direction, elements, .. } in self.whole() {
            let mean_square = mean_squares[&self.definition.unit_of(&elements)];
            let elements = if self.definition.is_image() { vec![0] } else { elements };
            let is_stored = |metric: &Metric| *metric != Metric::RelativeError || self.is_change();
            for metric in Metric::of(&self.definition).into_iter().filter(is_stored) {
                let mut add = |name: Metric, of: &dyn Fn(&Totals) -> Vec<Series>| {
                    let of_elements = |totals: &Totals| -> Vec<Series> {
                        let all = of(totals);
                        elements.iter().map(|element| all[*element]).collect()
                    };
                    let modality = self.definition.name;
                    let sums = self.of_episodes(metric, mean_square, &of_elements);
                    found.extend(sums.map(|(episode, [numerator, denominator])| EpisodeSums {
                        modality,
                        direction,
                        metric: name,
                        episode,
                        numerator,
                        denominator,
                    }));
                };
                add(metric, &|totals| totals.columns.clone());
                let has_regions = matches!(metric, Metric::R2 | Metric::RelativeError);
                for (place, region) in self.regions.iter().enumerate() {
                    if has_regions && self.is_defined_in(&region.name, metric) {
                        add(metric.in_region(&region.name), &|totals| totals.regions[place].clone());
                    }
                }
            }
        }
        found
    }

    /// Returns each episode with the sums of a metric over the series that `of` takes from the totals at its end.
    fn of_episodes(
        &self,
        metric: Metric,
        mean_square: f64,
        of: &dyn Fn(&Totals) -> Vec<Series>,
    ) -> impl Iterator<Item = (u32, [f64; 2])> {
        let totals: Vec<(u32, Vec<Series>)> =
            self.episodes.iter().map(|totals| (totals.episode, of(totals))).collect();
        let whole: Vec<Series> = totals.last().map_or_else(Vec::new, |(_, last)| last.clone());
        // R2 is computed without constant elements. In an episode, another element may be constant.
        let (counts, metric) = match metric {
            Metric::R2 => {
                let varies = |series: &Series| series.without_round_off(mean_square).varies();
                (whole.iter().map(varies).collect(), Metric::RelativeError)
            }
            metric => (vec![true; whole.len()], metric),
        };
        let is_change = self.is_change() && self.definition.is_image();
        let mut before = vec![Series::default(); whole.len()];
        totals.into_iter().filter_map(move |(episode, now)| {
            let own = now.iter().zip(&before).zip(&whole).zip(&counts).filter(|(_, counts)| **counts);
            let own: Vec<Series> = own.map(|(((now, before), whole), _)| now.since(before, whole)).collect();
            before = now;
            Some((episode, series::sums(metric, is_change, &own)?))
        })
    }

    /// The groups that together are all elements: one, or one for each unit.
    fn whole(&self) -> Vec<Group> {
        let definition = &self.definition;
        match definition.unit() {
            Some(_) => {
                let elements = (0..definition.width()).collect();
                vec![Group { direction: None, index: None, elements }]
            }
            None => definition
                .by_unit()
                .into_iter()
                .map(|(unit, elements)| Group {
                    direction: Some(Direction::in_unit(unit)),
                    index: None,
                    elements,
                })
                .collect(),
        }
    }

    fn groups(&self) -> Vec<Group> {
        let definition = &self.definition;
        let mut groups = self.whole();
        let own = definition.groups.iter().filter(|group| definition.unit_of(&group.elements).is_some());
        groups.extend(own.map(|group| Group {
            direction: Some(Direction::new(&group.name)),
            index: None,
            elements: group.elements.clone(),
        }));
        if !definition.is_image() {
            groups.extend((0..definition.width()).map(|element| Group {
                direction: definition.group_of(element).map(|group| Direction::new(&group.name)),
                index: Some(element as u32),
                elements: vec![element],
            }));
        }
        groups
    }
}

/// Elements whose metrics are computed together.
struct Group {
    direction: Option<Direction>,
    index: Option<u32>,
    elements: Vec<usize>,
}

/// Returns the metrics of one modality over samples in memory. [`Evaluation`] describes shapes, units and errors.
///
/// # Errors
/// When a value is not finite, or the numbers of values do not match.
pub fn evaluate(
    definition: &Definition,
    reference: &[f32],
    predicted: &[f32],
) -> Result<Vec<Row>, MetricsError> {
    let mut evaluation = Evaluation::new(definition, &[]);
    evaluation.add(reference, predicted)?;
    Ok(evaluation.rows())
}
