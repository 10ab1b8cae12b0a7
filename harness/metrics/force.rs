//! What a prediction of contact forces is worth, judged so that a few strong contacts do not decide: by the logarithm
//! of the force, by whether a link touches, by the phase of the contact, and by the predictive distribution.

use super::ensemble::{Distribution, Ensemble};
use super::error::{MetricsError, check_samples};
use super::series::{self, Series, smallest_mean_square};
use super::{Direction, Metric, Row, metric_unit};
use harness_spec::{CONTACT_PARTS as PARTS, Definition};
use rayon::prelude::*;

/// A link touches something if the force on it is above this, N.
pub const THRESHOLD_N: f32 = 0.05;

/// Links that touch in a smaller share of the samples have no metrics of their own, and none of the distribution.
pub const TOUCHED: f64 = 0.01;

/// The probabilities of the central intervals, in percent.
pub const INTERVALS: [u8; 2] = [50, 90];

/// Number of bins of the histogram of PIT values.
pub const BINS: usize = 10;

/// Returns the places in [`CONTACT_PARTS`](PARTS) of a pair.
fn parts(present: f32, reference: f32) -> &'static [usize] {
    match (present > THRESHOLD_N, reference > THRESHOLD_N) {
        (false, true) => &[0, 1],
        (true, true) => &[0, 2],
        (true, false) => &[3],
        (false, false) => &[4],
    }
}

/// Predictions of a force for a batch of samples. Matrices are row-major `[samples, links]`, in N.
pub struct Forces<'a> {
    /// The forces at the present samples.
    pub present: &'a [f32],
    /// The forces at the predicted samples.
    pub reference: &'a [f32],
    /// The predicted forces; the mean of the distribution if there is one.
    pub predicted: &'a [f32],
    /// The predictive distributions of the forces.
    pub ensemble: Option<&'a Ensemble>,
    /// A number for each sample, from which the random places of PIT values follow.
    pub seeds: &'a [u64],
}

/// Compares predicted forces with the reference, batch by batch. It stores 12 bytes for each pair of a link and a
/// sample, because ranks need all of them.
#[derive(Debug, Clone)]
pub struct ForceEvaluation {
    definition: Definition,
    links: Vec<Link>,
}

/// What is known of one link.
#[derive(Debug, Clone, Default)]
struct Link {
    all: Spread,
    /// In the order of [`CONTACT_PARTS`](PARTS).
    parts: [(Series, Spread); PARTS.len()],
    /// ln(1 + force) of the samples with a contact.
    logarithms: Series,
    touches: Touches,
    pairs: Vec<Pair>,
}

/// A reference, its prediction in N, and a number that is higher the more likely the contact is.
#[derive(Debug, Clone, Copy)]
struct Pair {
    reference: f32,
    predicted: f32,
    score: f32,
}

/// How often a contact is predicted, and is there.
#[derive(Debug, Clone, Copy, Default)]
struct Touches {
    both: f64,
    predicted: f64,
    there: f64,
}

/// Sums over predictive distributions.
#[derive(Debug, Clone, Copy, Default)]
struct Spread {
    count: f64,
    crps: f64,
    /// Number of distributions with intervals; the others are certain of one value.
    intervals: f64,
    covered: [f64; INTERVALS.len()],
    width: [f64; INTERVALS.len()],
    bins: [f64; BINS],
}

impl Spread {
    fn add(&mut self, distribution: Distribution, reference: f32, is_point: bool, random: f64) {
        self.count += 1.0;
        self.crps += distribution.crps(reference);
        if is_point {
            return;
        }
        self.add_place(distribution.pit(reference, random));
        for (place, percent) in INTERVALS.into_iter().enumerate() {
            let [low, high] = distribution.interval(f64::from(percent) / 100.0);
            self.add_interval(place, high - low, (low..=high).contains(&f64::from(reference)));
        }
    }

    /// Adds a distribution and a reference that touches. The interval and the PIT value are those of the distribution
    /// given a contact. A reference that touches although no member does is above all of them.
    fn add_contact(&mut self, distribution: Distribution, reference: f32, is_point: bool, random: f64) {
        self.count += 1.0;
        self.crps += distribution.crps(reference);
        if is_point {
            return;
        }
        let given_contact = distribution.given_above(THRESHOLD_N);
        let pit = given_contact.map_or(1.0, |members| members.pit(reference, random));
        self.add_place(pit);
        for (place, percent) in INTERVALS.into_iter().enumerate() {
            let share = f64::from(percent) / 100.0;
            let [low, high] = given_contact.map_or([0.0; 2], |members| members.interval(share));
            // Where few members touch, their PIT value says more than the bounds between them.
            self.add_interval(place, high - low, (pit - 0.5).abs() <= share / 2.0);
        }
    }

    fn add_place(&mut self, pit: f64) {
        self.intervals += 1.0;
        self.bins[((pit * BINS as f64) as usize).min(BINS - 1)] += 1.0;
    }

    fn add_interval(&mut self, place: usize, width: f64, is_covered: bool) {
        self.covered[place] += f64::from(u8::from(is_covered));
        self.width[place] += width;
    }

    /// Returns the share or mean that a metric of the distribution is, pooled; `None` if it isn't defined.
    fn value(metric: Metric, spreads: &[Spread]) -> Option<f64> {
        let sum = |of: &dyn Fn(&Spread) -> f64| spreads.iter().map(of).sum::<f64>();
        let place = |percent: u8| INTERVALS.iter().position(|known| *known == percent);
        let (sum, count) = match metric {
            Metric::Crps => (sum(&|spread| spread.crps), sum(&|spread| spread.count)),
            Metric::Coverage(percent) => {
                let place = place(percent)?;
                (sum(&|spread| spread.covered[place]), sum(&|spread| spread.intervals))
            }
            Metric::Width(percent) => {
                let place = place(percent)?;
                (sum(&|spread| spread.width[place]), sum(&|spread| spread.intervals))
            }
            Metric::Pit(bin) => {
                (sum(&|spread| spread.bins[usize::from(bin)]), sum(&|spread| spread.intervals))
            }
            _ => return None,
        };
        (count > 0.0).then(|| sum / count)
    }
}

impl Link {
    fn add(
        &mut self,
        present: f32,
        pair: Pair,
        [logarithm, median]: [f32; 2],
        spread: impl Fn(&mut Spread, bool),
    ) {
        let Pair { reference, predicted, .. } = pair;
        let (is_there, is_predicted) = (reference > THRESHOLD_N, median > THRESHOLD_N);
        spread(&mut self.all, false);
        for &part in parts(present, reference) {
            let (errors, of_part) = &mut self.parts[part];
            errors.add_points(reference, predicted, median);
            spread(of_part, is_there);
        }
        if is_there {
            self.logarithms.add(f64::from(reference).ln_1p() as f32, logarithm);
        }
        let count = |holds: bool| f64::from(u8::from(holds));
        self.touches.there += count(is_there);
        self.touches.predicted += count(is_predicted);
        self.touches.both += count(is_there && is_predicted);
        self.pairs.push(pair);
    }

    /// Returns whether the link touches often enough for metrics of its own.
    fn is_touched(&self) -> bool {
        self.touches.there > 0.0 && self.touches.there >= TOUCHED * self.pairs.len() as f64
    }

    /// Returns the sums without the 1 % of the samples whose reference is farthest from its mean. Of those that are
    /// equally far, the first ones are left out.
    fn trimmed(&self) -> Series {
        let mean =
            self.pairs.iter().map(|pair| f64::from(pair.reference)).sum::<f64>() / self.pairs.len() as f64;
        let deviation = |place: &usize| (f64::from(self.pairs[*place].reference) - mean).abs();
        let mut places: Vec<usize> = (0..self.pairs.len()).collect();
        places.sort_by(|one, other| deviation(other).total_cmp(&deviation(one)));
        let mut kept = places.split_off(self.pairs.len() / 100);
        kept.sort_unstable();
        kept.into_iter().map(|place| (self.pairs[place].reference, self.pairs[place].predicted)).collect()
    }
}

impl ForceEvaluation {
    /// Creates an evaluation of a modality that is a force.
    pub fn new(definition: &Definition) -> Self {
        Self { definition: definition.clone(), links: vec![Link::default(); definition.width()] }
    }

    /// Adds a batch, whose values are finite.
    ///
    /// # Errors
    /// When the shapes differ. Nothing is added in that case.
    pub fn add(&mut self, forces: &Forces) -> Result<(), MetricsError> {
        let Forces { present, reference, predicted, ensemble, seeds } = *forces;
        let width = self.links.len();
        let expected = ("the reference", reference.len() / width);
        check_samples(expected, ("the present", present.len() / width))?;
        check_samples(expected, ("the prediction", predicted.len() / width))?;
        check_samples(expected, ("the ensemble", ensemble.map_or(seeds.len(), |all| all.values() / width)))?;
        self.links.par_iter_mut().enumerate().for_each(|(element, link)| {
            for (row, &seed) in seeds.iter().enumerate() {
                let place = row * width + element;
                let (reference, predicted) = (reference[place], predicted[place]);
                let distribution = ensemble.map(|all| all.at(place));
                let logarithm = |force: f32| f64::from(force.max(0.0)).ln_1p();
                let (score, logarithm, median) = match distribution {
                    Some(all) => (all.above(THRESHOLD_N), all.mean(logarithm), all.quantile(0.5)),
                    None => (predicted.into(), logarithm(predicted), predicted.into()),
                };
                let pair = Pair { reference, predicted, score: score as f32 };
                let random = uniform(seed.wrapping_mul(width as u64).wrapping_add(element as u64));
                let judged = distribution.unwrap_or(Distribution::certain(&predicted));
                link.add(present[place], pair, [logarithm as f32, median as f32], |spread, given_contact| {
                    let add = if given_contact { Spread::add_contact } else { Spread::add };
                    add(spread, judged, reference, distribution.is_none(), random);
                });
            }
        });
        Ok(())
    }

    /// Returns the metrics of all batches so far: of all links together first, then of each link that touches often
    /// enough. Those of the distribution leave out all other links.
    pub fn rows(&self) -> Vec<Row> {
        let touched: Vec<usize> =
            (0..self.links.len()).filter(|link| self.links[*link].is_touched()).collect();
        let all: Vec<usize> = (0..self.links.len()).collect();
        let mut rows = self.rows_of(&all, &touched, None);
        for &link in &touched {
            rows.extend(self.rows_of(&[link], &[link], Some(link)));
        }
        rows
    }

    /// Returns the metrics of `links`, and those of the distribution of the links that are `touched`.
    fn rows_of(&self, links: &[usize], touched: &[usize], index: Option<usize>) -> Vec<Row> {
        let mut rows = Vec::new();
        let direction = index.and_then(|link| self.definition.group_of(link));
        let mut add = |base: Metric, metric: Metric, value: Option<f64>| {
            rows.push(Row {
                modality: self.definition.name,
                direction: direction.map(|group| Direction::new(&group.name)),
                index: index.map(|link| link as u32),
                metric,
                value,
                unit: metric_unit(&self.definition, base, links),
            });
        };
        let of_links =
            |of: &dyn Fn(&Link) -> Series| links.iter().map(|link| of(&self.links[*link])).collect();
        let mut add_whole = |metric, value| add(metric, metric, value);
        add_whole(Metric::LogR2, r2(of_links(&|link| link.logarithms)));
        add_whole(Metric::TrimmedR2, r2(of_links(&Link::trimmed)));
        add_whole(Metric::F1, self.f1(links));
        add_whole(Metric::Auc, self.auc(links));
        for (part, name) in PARTS.into_iter().enumerate() {
            let errors: Vec<Series> = of_links(&|link| link.parts[part].0);
            // Without a contact, the force is about zero, so that only the absolute errors are defined.
            let is_absolute = |metric: &Metric| matches!(metric, Metric::Rmse | Metric::Mae);
            let has_force = !matches!(name, "release" | "free");
            let metrics = Metric::of(&self.definition).into_iter();
            for metric in metrics.filter(|metric| is_absolute(metric) || (has_force && index.is_none())) {
                let value = match metric {
                    Metric::R2 => r2(errors.clone()),
                    metric => series::value(metric, false, &errors),
                };
                add(metric, metric.in_region(name), value);
            }
        }
        // A single link has only its CRPS, which keeps the tables short.
        let has_intervals = index.is_none() && self.links.iter().any(|link| link.all.intervals > 0.0);
        let of_intervals = || Metric::DISTRIBUTION.into_iter().filter(|metric| *metric != Metric::Crps);
        let metrics = [Metric::Crps].into_iter().chain(of_intervals().filter(|_| has_intervals));
        for metric in metrics {
            let spreads = |of: &dyn Fn(&Link) -> Spread| -> Vec<Spread> {
                touched.iter().map(|link| of(&self.links[*link])).collect()
            };
            add(metric, metric, Spread::value(metric, &spreads(&|link| link.all)));
            for (part, name) in PARTS.into_iter().enumerate() {
                add(
                    metric,
                    metric.in_region(name),
                    Spread::value(metric, &spreads(&|link| link.parts[part].1)),
                );
            }
        }
        rows
    }

    /// Returns the harmonic mean of precision and recall of contacts; `None` if there is none, predicted or not.
    fn f1(&self, links: &[usize]) -> Option<f64> {
        let touches = || links.iter().map(|link| self.links[*link].touches);
        let all: f64 = touches().map(|touches| touches.predicted + touches.there).sum();
        (all > 0.0).then(|| 2.0 * touches().map(|touches| touches.both).sum::<f64>() / all)
    }

    /// Returns the probability that a pair with a contact has a higher score than one without, an equal score counting
    /// half; `None` if either kind is missing.
    fn auc(&self, links: &[usize]) -> Option<f64> {
        let pairs = links.iter().flat_map(|link| &self.links[*link].pairs);
        let mut scores: Vec<(f32, bool)> =
            pairs.map(|pair| (pair.score + 0.0, pair.reference > THRESHOLD_N)).collect();
        scores.sort_unstable_by(|one, other| one.0.total_cmp(&other.0));
        let (mut lower, mut with, mut higher) = (0.0, 0.0, 0.0);
        for equal in scores.chunk_by(|one, other| one.0 == other.0) {
            let touching = equal.iter().filter(|(_, touches)| *touches).count() as f64;
            let others = equal.len() as f64 - touching;
            higher += touching * (lower + others / 2.0);
            lower += others;
            with += touching;
        }
        (with > 0.0 && lower > 0.0).then(|| higher / (with * lower))
    }
}

/// Returns R2 of some links, of which those that vary only by round-off are left out.
fn r2(series: Vec<Series>) -> Option<f64> {
    let mean_square = series.iter().map(Series::mean_square).fold(smallest_mean_square(Some("N")), f64::max);
    let series: Vec<Series> =
        series.into_iter().map(|series| series.without_round_off(mean_square)).collect();
    series::value(Metric::R2, false, &series)
}

/// Returns a number from 0 to 1, excluding 1, which is the same for the same seed (SplitMix64; Steele, Lea and Flood,
/// 2014, *Fast splittable pseudorandom number generators*).
fn uniform(seed: u64) -> f64 {
    let mut bits = seed.wrapping_add(0x9E37_79B9_7F4A_7C15);
    bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((bits ^ (bits >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
}
