//! The experiments, and the variants of each, whose predictions the page compares by joint and link.

use super::{Absent, Asked, Part, part};
use harness_analysis::{Analysis, Labels, Run};
use harness_figures::source::{Experiments, Runs, Source, Study, input_words, variants};
use harness_figures::{FigureError, OfReading};
use harness_metrics::Direction;
use harness_spec::{Definition, Modality, Origin, Scenario};
use std::collections::BTreeSet;

/// The most variants of an experiment whose predictions are shown.
const MOST_VARIANTS: usize = 6;

/// An experiment, or one of its variants, whose predictions are shown.
pub struct Subject {
    /// The name in the page's data, which no other subject has.
    pub name: String,
    experiment: String,
    /// The variant of the runs; `None` for all runs of the experiment.
    variant: Option<String>,
    /// What tells its networks from those of the other subjects, in words.
    pub words: String,
    /// The vectors whose predictions are shown.
    pub modalities: BTreeSet<Modality>,
}

/// The experiments that stand for the paper's two in figures. On a page of some experiments, a study whose own
/// experiment is not among them is replaced by the first one whose networks have exactly the study's inputs. A reading
/// stands for both.
pub fn studies(analysis: &Analysis, asked: &Asked, reading: Option<&OfReading>) -> Experiments {
    let paper = Experiments::of_the_paper(asked.is_quick());
    if let Some(reading) = reading {
        return paper.replaced_by(reading.experiment());
    }
    let name = |study: Study| {
        let own = paper.of(study);
        if asked.experiments.iter().any(|name| name == own) {
            return own.to_owned();
        }
        let is_like = |run: &Run| {
            let spec = &run.record.spec;
            is_of_the_paper(&spec.scenario) && spec.input == study.input()
        };
        let mut chosen = asked.experiments.iter().filter(|name| has_finger(analysis, name));
        let like = chosen.find(|name| analysis.runs(name).iter().all(is_like));
        like.map_or(own, String::as_str).to_owned()
    };
    let [single_to_multi, multi_to_multi] = Study::BOTH.map(name);
    Experiments { single_to_multi, multi_to_multi, ..paper }
}

/// What is shown: the asked experiments with all their vectors, each variant by itself, or the paper's two with joint
/// angles and contact forces. The second value has a remark for each experiment with too many variants.
pub fn subjects(source: &Source, asked: &Asked) -> (Vec<Subject>, Vec<String>) {
    let analysis = source.analysis;
    if asked.experiments.is_empty() {
        // The paper's parts compare finger with finger.
        let own = Study::BOTH.into_iter().filter(|study| has_finger(analysis, source.experiments.of(*study)));
        let subject = |study: Study| {
            let (experiment, runs) = (source.experiments.of(study), source.runs(study).ok());
            Subject {
                name: study.name().to_owned(),
                experiment: experiment.to_owned(),
                words: runs.as_ref().map_or_else(|| experiment.to_owned(), Runs::input),
                modalities: BTreeSet::from([Modality::PROPRIOCEPTION, Modality::CONTACT_FORCE]),
                variant: runs.and_then(|runs| runs.variant),
            }
        };
        return (own.map(subject).collect(), Vec::new());
    }
    let (mut subjects, mut remarks) = (Vec::new(), Vec::new());
    for experiment in &asked.experiments {
        let variants = variants(analysis, experiment);
        if variants.len() > MOST_VARIANTS {
            remarks.push(format!(
                "charts and images show the first {MOST_VARIANTS} of the {} variants of {experiment}; `--where \
                 'variant=…'` chooses others, and the tables of metrics have all",
                variants.len()
            ));
        }
        match variants.len() {
            0 | 1 => subjects.push(Subject::of(analysis, asked, experiment, None)),
            _ => subjects.extend(
                variants
                    .into_iter()
                    .take(MOST_VARIANTS)
                    .map(|variant| Subject::of(analysis, asked, experiment, Some(variant))),
            ),
        }
    }
    (subjects, remarks)
}

impl Subject {
    /// An asked experiment, or one of its variants.
    fn of(analysis: &Analysis, asked: &Asked, experiment: &str, variant: Option<String>) -> Self {
        let is_own = |run: &&Run| variant.as_ref().is_none_or(|variant| run.record.spec.variant == *variant);
        let runs = || analysis.runs(experiment).iter().filter(is_own);
        let label = variant.as_ref().map(|variant| Labels::new(analysis, &[]).variant(variant));
        let own = label.map(|label| label.text().to_owned()).filter(|label| !label.is_empty());
        let words = match (own, asked.experiments.len()) {
            (Some(own), 1) => own,
            (Some(own), _) => format!("{experiment}, {own}"),
            (None, 1) => runs().next().map_or_else(|| experiment.to_owned(), of_input),
            (None, _) => experiment.to_owned(),
        };
        let name = variant.iter().fold(experiment.to_owned(), |name, variant| format!("{name} {variant}"));
        let modalities = runs().flat_map(vectors).collect();
        Self { name, experiment: experiment.to_owned(), words, modalities, variant }
    }
}

/// The inputs of a run's network, in words.
fn of_input(run: &Run) -> String {
    input_words(&run.record.spec.input)
}

/// The vectors that a run predicts.
fn vectors(run: &Run) -> Vec<Modality> {
    let is_vector = |modality: &&Modality| {
        let own = run.record.layout.get(**modality);
        own.is_some_and(|definition| !definition.is_image() && !definition.has_own_loss())
    };
    run.record.spec.output.iter().filter(is_vector).copied().collect()
}

/// The scenarios of the paper that the runs of the asked experiments are in.
pub fn scenarios(analysis: &Analysis, asked: &Asked) -> Vec<Scenario> {
    let runs = || asked.experiments.iter().flat_map(|name| analysis.runs(name));
    let is_there =
        |scenario: &Scenario| runs().any(|run| run.record.spec.scenario == Origin::Simulated(*scenario));
    Scenario::PAPER
        .into_iter()
        .filter(|scenario| asked.experiments.is_empty() || is_there(scenario))
        .collect()
}

/// Whether a scenario is one of the paper's two.
pub fn is_of_the_paper(scenario: &Origin) -> bool {
    matches!(scenario, Origin::Simulated(scenario) if Scenario::PAPER.contains(scenario))
}

/// The direction of a joint or link, if it is one of the paper's two.
pub fn direction_of(definition: &Definition, element: usize) -> Option<Direction> {
    Direction::FINGER.into_iter().find(|direction| direction.elements(definition).contains(&element))
}

/// Whether the runs of an experiment sense a finger: the world groups its joints, and the links whose contact forces
/// are sensed, by the paper's two directions.
fn has_finger(analysis: &Analysis, experiment: &str) -> bool {
    let is_grouped = |definition: &Definition| {
        let directions = (0..definition.width()).map(|element| direction_of(definition, element));
        directions.collect::<BTreeSet<_>>() == BTreeSet::from(Direction::FINGER.map(Some))
    };
    let is_finger = |run: &Run| {
        let layout = &run.record.layout;
        layout.get(Modality::PROPRIOCEPTION).is_some_and(is_grouped)
            && layout.get(Modality::CONTACT_FORCE).is_none_or(is_grouped)
    };
    analysis.runs(experiment).iter().all(is_finger)
}

/// Calls `of_subject` with the runs of each subject. Returns all results, and a reason for each subject without runs.
pub fn of_each<T>(
    source: &Source,
    subjects: &[Subject],
    asked: &Asked,
    of_subject: impl Fn(&Runs, &Subject) -> Result<Vec<T>, FigureError>,
) -> Result<(Vec<T>, BTreeSet<Absent>), FigureError> {
    let (mut all, mut absent) = (Vec::new(), BTreeSet::new());
    for subject in subjects {
        let runs = source.runs_of(&subject.experiment, subject.variant.as_deref());
        let found = runs.and_then(|runs| of_subject(&runs, subject));
        match part(found, asked)? {
            Part::There(more) => all.extend(more),
            Part::Absent(reason) => drop(absent.insert(reason)),
        }
    }
    Ok((all, absent))
}
