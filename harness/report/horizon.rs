//! Collects the metrics of networks and baselines over the horizon.

use super::{Asked, ReportError, short};
use harness_analysis::{Analysis, AnalysisError, Key, Label, Mean, Question, replicates_of};
use harness_metrics::Metric;
use harness_spec::{Origin, Task};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// A metric of one model at each horizon.
#[derive(Serialize)]
pub struct Curve {
    /// The name of the experiment.
    study: String,
    scenario: Origin,
    /// The modality, with the unit of its elements if they are only a part of it.
    modality: String,
    metric: String,
    unit: String,
    /// The network or baseline, in words.
    name: String,
    model: String,
    /// The time from one sample to the next, s; `None` if it is not known.
    seconds: Option<f64>,
    /// What the intervals are over.
    over: String,
    /// Horizon in samples, mean, and the ends of the interval, if there is one.
    points: Vec<Vec<f64>>,
}

/// What tells the curves of a panel apart. Networks come first, in the order of their variants.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
struct Model {
    is_baseline: bool,
    name: String,
    variant: Label,
    latent: Option<usize>,
    settings: String,
}

/// The means of a model by horizon.
type ByHorizon<'a> = BTreeMap<usize, &'a Mean>;

/// Returns the curves of the asked experiments whose runs predict further than one sample; none on the page of all
/// results.
///
/// # Errors
/// When a table is damaged.
pub fn curves(analysis: &Analysis, asked: &Asked) -> Result<Vec<Curve>, ReportError> {
    if asked.experiments.is_empty() {
        return Ok(Vec::new());
    }
    let general = Metric::GENERAL.into_iter().chain([Metric::Skill]);
    let question = Question {
        experiments: asked.experiments.clone(),
        task: Some(Task::Prediction),
        metrics: general.map(|metric| metric.name().to_owned()).collect(),
        by: vec![Key::Horizon],
        ..Question::default()
    };
    let answer = match question.answer(analysis) {
        Err(AnalysisError::NoMeans(_)) => return Ok(Vec::new()),
        answer => answer?,
    };
    let (means, labels) = (&answer.cells, &answer.labels);
    // The curves of a panel are drawn together.
    let mut panels: BTreeMap<_, BTreeMap<Model, ByHorizon>> = BTreeMap::new();
    for mean in means {
        let of = &mean.of;
        let panel = (&of.experiment, &of.scenario, of.predicted(), &of.metric);
        let model = Model {
            is_baseline: of.is_baseline(),
            name: of.model.clone(),
            variant: labels.variant(&of.variant),
            latent: of.latent,
            settings: of.settings.clone(),
        };
        let Some(horizon) = of.horizon else { continue };
        panels.entry(panel).or_default().entry(model).or_default().insert(horizon, mean);
    }
    let seconds = analysis.sample_rate_hz().map(|rate| 1.0 / rate);
    Ok(panels.into_values().flat_map(|models| curves_of(models, seconds)).collect())
}

/// The curves of a panel. Baselines of several networks with the same points are one curve.
fn curves_of(models: BTreeMap<Model, ByHorizon>, seconds: Option<f64>) -> Vec<Curve> {
    let latents: BTreeSet<_> = models.keys().filter_map(|model| model.latent).collect();
    let mut baselines: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    let mut curves = Vec::new();
    for (model, by_horizon) in models {
        let points: Vec<Vec<f64>> = by_horizon.iter().map(|(horizon, mean)| point(*horizon, mean)).collect();
        let Some(first) = by_horizon.values().next().filter(|_| points.len() > 1) else { continue };
        let name = model.name.replace('_', " ");
        let known = baselines.entry(name.clone()).or_default();
        if model.is_baseline && !known.insert(format!("{points:?}")) {
            continue;
        }
        let latent = model.latent.filter(|_| latents.len() > 1).map(|latent| format!("z = {latent}"));
        let words = [Some(model.variant.text().to_owned()), latent, Some(model.settings)];
        let words =
            words.into_iter().flatten().filter(|word| !word.is_empty()).collect::<Vec<_>>().join(", ");
        let name = match (model.is_baseline, known.len(), words.is_empty()) {
            (true, 1, _) | (_, _, true) => name,
            (true, ..) => format!("{name}, {words}"),
            (false, ..) => words,
        };
        curves.push(Curve {
            study: first.of.experiment.clone(),
            scenario: first.of.scenario.clone(),
            modality: first.of.predicted(),
            metric: first.of.metric.clone(),
            unit: first.unit.clone(),
            name,
            model: model.name,
            seconds,
            over: replicates_of(by_horizon.values().copied()).unwrap_or_else(|| "one seed".to_owned()),
            points,
        });
    }
    curves
}

fn point(horizon: usize, mean: &Mean) -> Vec<f64> {
    let bounds = mean.interval.bounds.filter(|(low, high)| low < high);
    let ends = bounds.into_iter().flat_map(|(low, high)| [low, high]);
    [horizon as f64].into_iter().chain([mean.interval.mean].into_iter().chain(ends).map(short)).collect()
}
