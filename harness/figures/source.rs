//! The runs of the paper's experiments and their tables, from which figures are drawn.

use super::FigureError;
use super::reading::OfReading;
use harness_analysis::{Analysis, AnalysisError, Labels, Run, Setting};
use harness_spec::{Layout, Modality, Origin, QUICK, RunSpec};
use polars::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::Path;
use std::sync::Arc;

/// One of the paper's two experiments. Each has a spec of its name in `experiments/`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Study {
    /// The networks' only input is proprioception.
    SingleToMulti,
    /// The networks' inputs are proprioception and vision.
    MultiToMulti,
}

impl Study {
    /// Both studies, the one without vision first.
    pub const BOTH: [Study; 2] = [Study::SingleToMulti, Study::MultiToMulti];

    /// The name of the study's experiment, which is also the role of its runs in the readings.
    pub fn name(self) -> &'static str {
        match self {
            Study::SingleToMulti => "single_to_multi",
            Study::MultiToMulti => "multi_to_multi",
        }
    }

    /// The inputs of the study's networks.
    pub fn input(self) -> &'static [Modality] {
        match self {
            Study::SingleToMulti => &[Modality::PROPRIOCEPTION],
            Study::MultiToMulti => &[Modality::PROPRIOCEPTION, Modality::VISION],
        }
    }
}

/// The inputs of networks in words for people: `from proprioception + vision`.
pub fn input_words(input: &[Modality]) -> String {
    let names: Vec<String> = input.iter().map(|input| input.name().replace('_', " ")).collect();
    format!("from {}", names.join(" + "))
}

/// The names of the experiments whose runs are drawn.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Experiments {
    /// The experiment of [`Study::SingleToMulti`].
    pub single_to_multi: String,
    /// The experiment of [`Study::MultiToMulti`].
    pub multi_to_multi: String,
    /// The experiment whose runs predict several samples ahead.
    pub horizons: String,
}

impl Experiments {
    /// The paper's experiments; with `quick`, those that `harness run … --quick` makes.
    pub fn of_the_paper(quick: bool) -> Self {
        let name = |name: &str| format!("{name}{}", if quick { QUICK } else { "" });
        Self {
            single_to_multi: name(Study::SingleToMulti.name()),
            multi_to_multi: name(Study::MultiToMulti.name()),
            horizons: name("hidden_stiffness"),
        }
    }

    /// One experiment for all figures.
    pub fn all_of(experiment: &str) -> Self {
        let named = || experiment.to_owned();
        Self { single_to_multi: named(), multi_to_multi: named(), horizons: named() }
    }

    /// The same, with this experiment for both studies.
    pub fn replaced_by(self, experiment: &str) -> Self {
        Self { horizons: self.horizons, ..Self::all_of(experiment) }
    }

    /// The name of a study's experiment.
    pub fn of(&self, study: Study) -> &str {
        match study {
            Study::SingleToMulti => &self.single_to_multi,
            Study::MultiToMulti => &self.multi_to_multi,
        }
    }

    /// The names of the two studies' experiments.
    pub fn names(&self) -> [String; 2] {
        Study::BOTH.map(|study| self.of(study).to_owned())
    }

    /// The names of all experiments.
    pub fn all(&self) -> Vec<String> {
        self.names().into_iter().chain([self.horizons.clone()]).collect()
    }
}

/// The runs that an analysis selects, grouped by study.
pub struct Source<'a> {
    /// The runs that count.
    pub analysis: &'a Analysis,
    /// The names of the experiments whose runs are drawn.
    pub experiments: Experiments,
    pub(super) modality: Option<String>,
    /// The variant of the runs that are drawn; `None` for all runs.
    pub(super) variant: Option<String>,
    /// The reading whose runs stand for the studies; `None` for the experiments' runs.
    reading: Option<&'a OfReading>,
}

/// The runs of a study. They differ only in scenario, latent size and seed.
pub struct Runs<'a> {
    analysis: &'a Analysis,
    /// The experiment's name.
    pub experiment: String,
    /// The variant of the runs, if they were selected by it.
    pub variant: Option<String>,
    /// The runs, sorted by scenario, latent size and seed.
    pub all: Vec<&'a Run>,
}

/// The variants of the runs of an experiment, in the order of its spec. There is one if the experiment varies nothing.
pub fn variants(analysis: &Analysis, experiment: &str) -> Vec<String> {
    let labels = Labels::new(analysis, &[]);
    let own = analysis.runs(experiment).iter().map(|run| run.record.spec.variant.as_str());
    let variants: BTreeSet<_> = own.map(|variant| (labels.variant(variant), variant)).collect();
    variants.into_iter().map(|(_, variant)| variant.to_owned()).collect()
}

impl<'a> Source<'a> {
    /// A source of figures. The analysis must have all runs of `experiments` on simulated data, and no other runs of
    /// these experiments.
    pub fn new(analysis: &'a Analysis, experiments: Experiments) -> Self {
        Self { analysis, experiments, modality: None, variant: None, reading: None }
    }

    /// The same source, in which the runs of each study are those in the study's role under this reading.
    pub fn under(self, reading: Option<&'a OfReading>) -> Self {
        Self { reading, ..self }
    }

    /// The same source, from which the figure over the horizon shows this modality, or its elements with one unit
    /// (`joints in rad`). `None` for the contact force or, where it is not predicted, the first modality.
    pub fn showing(self, modality: Option<String>) -> Self {
        Self { modality, ..self }
    }

    /// The same source, from which only runs of this variant are drawn. `None` for all runs.
    pub(crate) fn only(self, variant: Option<String>) -> Self {
        Self { variant, ..self }
    }

    /// The runs of a study.
    ///
    /// # Errors
    /// When the study has no runs; the message names the command that makes them, if there is one. Also when the runs
    /// can't be shown in one figure; the message names the settings in which they differ.
    pub fn runs(&self, study: Study) -> Result<Runs<'a>, FigureError> {
        let experiment = self.experiments.of(study);
        let Some(of) = self.reading else {
            return self.runs_of(experiment, self.variant.as_deref());
        };
        match self.analysis.runs_under(of.experiment(), of.reading(), study.name()).first() {
            Some(run) => self.runs_of(&run.record.experiment, Some(&run.record.spec.variant)),
            None => {
                let excluded_by = self.analysis.excluding(of.experiment(), of.reading(), study.name());
                Err(FigureError::NoRole {
                    experiment: experiment.to_owned(),
                    reading: of.reading().to_owned(),
                    role: study.name(),
                    command: command(self.analysis, experiment).filter(|_| excluded_by.is_empty()),
                    excluded_by,
                })
            }
        }
    }

    /// The runs of an experiment, or only those of a variant.
    ///
    /// # Errors
    /// Like [`runs`](Self::runs).
    pub fn runs_of(&self, experiment: &str, variant: Option<&str>) -> Result<Runs<'a>, FigureError> {
        let runs = self.selected(experiment, variant)?;
        match variant {
            None => self.analysis.check_uniform(experiment, false)?,
            Some(_) => self.analysis.check_alike(&runs.all)?,
        }
        Ok(runs)
    }

    /// The runs of an experiment, for what describes only their data. If several datasets of a scenario have the same
    /// seed, they are those of the variant that is drawn.
    ///
    /// # Errors
    /// Like [`runs`](Self::runs).
    pub(crate) fn runs_for_data(&self, experiment: &str) -> Result<Runs<'a>, FigureError> {
        let runs = self.selected(experiment, None)?;
        let mut datasets: BTreeMap<(&Origin, u64), &str> = BTreeMap::new();
        let is_the_only_one = |run: &&'a Run| {
            let (spec, dataset) = (&run.record.spec, run.record.dataset.as_str());
            *datasets.entry((&spec.scenario, spec.dataset_seed())).or_insert(dataset) == dataset
        };
        if runs.all.iter().all(is_the_only_one) {
            return Ok(runs);
        }
        self.runs_of(experiment, self.variant.as_deref())
    }

    /// The runs of an experiment, or only those of a variant.
    fn selected(&self, experiment: &str, variant: Option<&str>) -> Result<Runs<'a>, FigureError> {
        let analysis = self.analysis;
        let is_chosen = |run: &&Run| variant.is_none_or(|variant| run.record.spec.variant == variant);
        let all: Vec<&Run> = analysis.runs(experiment).iter().filter(is_chosen).collect();
        if all.is_empty() {
            return Err(no_runs(analysis, experiment));
        }
        let (experiment, variant) = (experiment.to_owned(), variant.map(str::to_owned));
        Ok(Runs { analysis, experiment, variant, all })
    }
}

pub(super) fn no_runs(analysis: &Analysis, experiment: &str) -> FigureError {
    // A command can't make runs with a setting that no override changes.
    let nothing = analysis.nothing_of(experiment);
    let is_fixed = |wanted: &[Setting]| wanted.iter().any(|setting| setting.as_override().is_none());
    if matches!(&nothing, AnalysisError::NothingChosen { wanted, .. } if is_fixed(wanted)) {
        return nothing.into();
    }
    FigureError::NoRuns {
        experiment: experiment.to_owned(),
        root: analysis.root().to_owned(),
        command: command(analysis, experiment),
        there: analysis.all_finished(),
    }
}

fn no_rows(analysis: &Analysis, experiment: &str) -> FigureError {
    let (name, quick) = experiment.strip_suffix(QUICK).map_or((experiment, false), |name| (name, true));
    // A command that makes the same runs again changes nothing.
    let adds = |_: &String| {
        let there = analysis.finished_specs(experiment);
        let spec = harness_spec::load(Path::new(name), &[], quick);
        spec.is_ok_and(|spec| !Contents::of(spec.runs().iter()).is_within(&Contents::of(there.iter())))
    };
    FigureError::NoRows {
        experiment: experiment.to_owned(),
        root: analysis.root().to_owned(),
        there: Contents::of(analysis.runs(experiment).iter().map(|run| &run.record.spec)).to_string(),
        command: command(analysis, experiment).filter(adds),
    }
}

/// The command that makes an experiment's runs, if there is one.
fn command(analysis: &Analysis, experiment: &str) -> Option<String> {
    match experiment.strip_suffix(QUICK) {
        Some(name) => analysis.command(name, true),
        None => analysis.command(experiment, false),
    }
}

impl<'a> Runs<'a> {
    /// The rows of a query over these runs.
    ///
    /// # Errors
    /// When the query can't be answered, or has no rows.
    pub fn query(&self, sql: &str) -> Result<DataFrame, FigureError> {
        // The tables of whole experiments are read once for several queries.
        let is_whole = self.all.len() == self.analysis.runs(&self.experiment).len();
        self.answered(match is_whole {
            true => self.analysis.query(&[&self.experiment], sql)?,
            false => self.analysis.query_runs(self.all.iter().copied(), sql)?,
        })
    }

    /// The rows of a query over one run per cell: the run with the lowest seed on the first dataset. Figures of single
    /// samples show only these networks.
    ///
    /// # Errors
    /// When the query can't be answered, or has no rows.
    pub fn query_first_seeds(&self, sql: &str) -> Result<DataFrame, FigureError> {
        let mut first = self.all.clone();
        first.sort_by_key(|run| {
            (run.record.spec.cell(), run.record.spec.dataset_seed(), run.record.spec.seed)
        });
        first.dedup_by_key(|run| run.record.spec.cell());
        self.answered(self.analysis.query_runs(first, sql)?)
    }

    fn answered(&self, answer: DataFrame) -> Result<DataFrame, FigureError> {
        match answer.height() {
            0 => Err(self.no_rows()),
            _ => Ok(answer),
        }
    }

    /// The error that the runs have nothing for a figure.
    pub fn no_rows(&self) -> FigureError {
        no_rows(self.analysis, &self.experiment)
    }

    /// The inputs of the runs' networks, as [`input_words`].
    pub fn input(&self) -> String {
        input_words(&self.all[0].record.spec.input)
    }

    /// The modalities of the samples in the runs' datasets.
    pub fn layout(&self) -> &'a Arc<Layout> {
        &self.all[0].record.layout
    }

    /// The latent sizes of the runs, ascending.
    pub fn latents(&self) -> Vec<usize> {
        let mut latents: Vec<usize> = self.all.iter().filter_map(|run| run.record.spec.latent()).collect();
        latents.sort_unstable();
        latents.dedup();
        latents
    }

    /// The number of datasets or seeds that the intervals of the cells' means are over, for example `3 datasets`, or
    /// `3 to 5 seeds` of one dataset. `None` if no cell has an interval.
    pub fn replicates(&self) -> Option<String> {
        let mut cells: BTreeMap<String, BTreeMap<u64, usize>> = BTreeMap::new();
        for run in &self.all {
            let spec = &run.record.spec;
            *cells.entry(spec.cell()).or_default().entry(spec.dataset_seed()).or_default() += 1;
        }
        let has_datasets = cells.values().any(|datasets| datasets.len() > 1);
        let counts = || {
            cells.values().map(|datasets| if has_datasets { datasets.len() } else { datasets.values().sum() })
        };
        let (fewest, most) = (counts().min()?, counts().max()?);
        let noun = if has_datasets { "datasets" } else { "seeds" };
        let count = if fewest < most { format!("{fewest} to {most}") } else { most.to_string() };
        (most > 1).then(|| format!("{count} {noun}"))
    }
}

/// The scenarios, tasks and outputs of runs.
struct Contents([(&'static str, BTreeSet<String>); 3]);

impl Contents {
    fn of<'a>(specs: impl Iterator<Item = &'a RunSpec>) -> Self {
        let mut all =
            [("scenarios", BTreeSet::new()), ("tasks", BTreeSet::new()), ("outputs", BTreeSet::new())];
        for spec in specs {
            all[0].1.insert(spec.scenario.name().to_owned());
            all[1].1.extend(spec.tasks.iter().map(ToString::to_string));
            all[2].1.extend(spec.output.iter().map(ToString::to_string));
        }
        Self(all)
    }

    fn is_within(&self, other: &Self) -> bool {
        self.0.iter().zip(&other.0).all(|((_, own), (_, others))| own.is_subset(others))
    }
}

impl fmt::Display for Contents {
    /// Writes `scenarios: empty; tasks: prediction; outputs: contact_force`.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let listed =
            |values: &BTreeSet<String>| values.iter().map(String::as_str).collect::<Vec<_>>().join(", ");
        let parts = self.0.iter().map(|(name, values)| format!("{name}: {}", listed(values)));
        f.write_str(&parts.collect::<Vec<_>>().join("; "))
    }
}

/// The values of a column of text.
///
/// # Errors
/// When the column is missing, isn't text, or contains null.
pub fn texts(table: &DataFrame, column: &str) -> Result<Vec<String>, FigureError> {
    let values = table.column(column)?.str()?;
    values.iter().map(|value| Ok(value.ok_or_else(|| null_in(column))?.to_owned())).collect()
}

/// The values of a column of integers.
///
/// # Errors
/// When the column is missing, can't be cast to integers, or contains null.
pub fn integers(table: &DataFrame, column: &str) -> Result<Vec<i64>, FigureError> {
    let values = table.column(column)?.cast(&DataType::Int64)?;
    values.i64()?.iter().map(|value| value.ok_or_else(|| null_in(column))).collect()
}

fn null_in(column: &str) -> FigureError {
    PolarsError::NoData(format!("the column '{column}' contains null").into()).into()
}

/// The values of a column of numbers. Null becomes `None`.
///
/// # Errors
/// When the column is missing or can't be cast to numbers.
pub(crate) fn reals(table: &DataFrame, column: &str) -> Result<Vec<Option<f64>>, FigureError> {
    let values = table.column(column)?.cast(&DataType::Float64)?;
    Ok(values.f64()?.iter().collect())
}

/// The column `dataset_seed`. An imported dataset, which has none, has the seed 0.
///
/// # Errors
/// When the column is missing or isn't numeric.
pub(crate) fn dataset_seeds(table: &DataFrame) -> Result<Vec<u64>, FigureError> {
    let seeds = table.column("dataset_seed")?.cast(&DataType::UInt64)?;
    Ok(seeds.u64()?.iter().map(Option::unwrap_or_default).collect())
}

/// The columns `dataset_seed` and `value` as pairs: each value with the seed of its dataset.
///
/// # Errors
/// When one of the columns is missing or isn't numeric.
pub(crate) fn replicated(table: &DataFrame) -> Result<Vec<(u64, Option<f64>)>, FigureError> {
    Ok(dataset_seeds(table)?.into_iter().zip(reals(table, "value")?).collect())
}
