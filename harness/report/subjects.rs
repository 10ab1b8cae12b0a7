//! The experiments whose predictions the page compares by joint and link.

use super::{Absent, Asked, Part, part};
use harness_analysis::{Analysis, Run};
use harness_figures::FigureError;
use harness_figures::source::{Experiments, Runs, Source, Study, input_words};
use harness_metrics::Direction;
use harness_spec::{Definition, Modality, Origin, Scenario};
use std::collections::BTreeSet;

/// An experiment whose predictions are shown.
pub struct Subject {
    /// The name of the study or experiment in the page's data.
    pub name: String,
    experiment: String,
    /// What tells its networks from those of the other subjects, in words.
    pub words: String,
    /// The vectors whose predictions are shown.
    pub modalities: BTreeSet<Modality>,
}

/// The experiments that stand for the paper's two in figures. On a page of some experiments, a study whose own
/// experiment is not among them is replaced by the first one whose networks have exactly the study's inputs.
pub fn roles(analysis: &Analysis, asked: &Asked) -> Experiments {
    let paper = Experiments::of_the_paper(asked.is_quick());
    let role = |study: Study| {
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
    let [single_to_multi, multi_to_multi] = Study::BOTH.map(role);
    Experiments { single_to_multi, multi_to_multi, ..paper }
}

/// The experiments whose predictions are shown: the asked ones with all their vectors, or the paper's two with joint
/// angles and contact forces.
pub fn subjects(analysis: &Analysis, asked: &Asked, roles: &Experiments) -> Vec<Subject> {
    let named: Vec<(&str, &str)> = match asked.experiments.is_empty() {
        true => Study::BOTH.map(|study| (study.name(), roles.of(study))).into(),
        false => asked.experiments.iter().map(|name| (name.as_str(), name.as_str())).collect(),
    };
    let words = |experiment: &str| match analysis.runs(experiment) {
        [run, ..] if asked.experiments.len() < 2 => input_words(&run.record.spec.input),
        _ => experiment.to_owned(),
    };
    let modalities = |experiment: &str| match asked.experiments.is_empty() {
        true => BTreeSet::from([Modality::PROPRIOCEPTION, Modality::CONTACT_FORCE]),
        false => analysis.runs(experiment).iter().flat_map(vectors).collect(),
    };
    // The paper's parts compare finger with finger.
    let is_shown = |experiment: &str| !asked.experiments.is_empty() || has_finger(analysis, experiment);
    let shown = named.into_iter().filter(|(_, experiment)| is_shown(experiment));
    let subject = |(name, experiment): (&str, &str)| Subject {
        name: name.to_owned(),
        experiment: experiment.to_owned(),
        words: words(experiment),
        modalities: modalities(experiment),
    };
    shown.map(subject).collect()
}

/// The vectors that a run predicts.
fn vectors(run: &Run) -> Vec<Modality> {
    let is_vector = |modality: &&Modality| {
        run.record.layout.get(**modality).is_some_and(|definition| !definition.is_image())
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
        let found = source.runs_of(&subject.experiment).and_then(|runs| of_subject(&runs, subject));
        match part(found, asked)? {
            Part::There(more) => all.extend(more),
            Part::Absent(reason) => drop(absent.insert(reason)),
        }
    }
    Ok((all, absent))
}
