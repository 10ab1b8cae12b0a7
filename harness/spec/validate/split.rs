//! The rules of a split, and of a test in a dataset of its own.

use super::{Fault, fault, unknown_world};
use crate::layout::Modality;
use crate::origin::Origin;
use crate::split::{Division, Split, Tested};
use crate::types::{Experiment, TestDataset};
use crate::yaml::unknown;

/// Refuses a split that leaves nothing for training, or whose settings contradict each other.
pub fn validate(experiment: &Experiment) -> Result<(), Fault> {
    let Experiment { split, simulation, window, scenarios, .. } = experiment;
    let (by, validation, test) = (split.by, split.validation, &split.test);
    let is_simulated = scenarios.iter().any(|origin| experiment.world(origin).is_some());
    let named = matches!(split.test, Tested::Groups(_));
    if let (true, Division::Label(label)) = (is_simulated, by) {
        let names: Vec<&str> = Division::ALL.iter().map(|division| division.name()).collect();
        let message = unknown("division", label, "split.by", &names, str::to_owned);
        return fault("split.by", format!("{message}; only recordings have labels"));
    }
    if is_simulated && split.folds.is_some() {
        return fault(
            "split.folds",
            "folds are for recordings; simulate several datasets instead, with vary: {simulation.seed: [0, 1, 2]}",
        );
    }
    if split.folds.is_some() && *test != Split::default().test {
        return fault("split.test", "each fold is the test of a run; leave out split.test, or split.folds");
    }
    if split.fold.is_some_and(|fold| split.folds.is_none_or(|folds| fold >= folds)) {
        return fault("split.fold", "there is no such fold; they count from 0 to below split.folds");
    }
    for (key, is_set) in [("folds", split.folds.is_some()), ("seed", split.seed.is_some()), ("test", named)] {
        if is_set && !by.keeps_episodes() {
            let message =
                format!("a split by {by} has no groups; leave it out, or use split.by: episode or a label");
            return fault(format!("split.{key}"), message);
        }
    }
    if let Some(test) = &experiment.test {
        return test_dataset(experiment, test);
    }
    if split.gap_seconds.is_some() && by != Division::Time {
        return fault(
            "split.gap_seconds",
            format!("a split by {by} has no gap; leave it out, or use split.by: time"),
        );
    }
    // The episodes of an imported dataset are not those of `simulation`. They are checked when it is opened.
    if !is_simulated {
        return Ok(());
    }
    let (episodes, samples) = (simulation.episodes as usize, simulation.samples_per_episode());
    let windows = episodes * (samples + 1).saturating_sub(window.samples());
    match by {
        Division::Episode if episodes < 3 => fault(
            "simulation.episodes",
            format!(
                "a split by episode needs at least 3 episodes, one each for training, validation and test, found \
                 {episodes}; use more, or split.by: time, which divides each episode"
            ),
        ),
        Division::Episode if !named && split.counts(episodes, false).is_none() => fault(
            "split",
            format!(
                "validation {validation} and test {test} of {episodes} episodes leave none for training; \
                 use smaller shares or more episodes"
            ),
        ),
        Division::Time if split.times(samples, window.samples(), simulation.sample_rate_hz).is_none() => {
            fault(
                "split",
                format!(
                    "validation {validation}, test {test} and two gaps of {} s leave nothing of an episode of {} s for \
                 training; use smaller shares, a smaller gap_seconds or more actuations_per_episode",
                    split.gap_seconds.unwrap_or(Split::GAP_SECONDS),
                    samples as f64 / simulation.sample_rate_hz,
                ),
            )
        }
        Division::Sample if split.counts(windows, false).is_none() => fault(
            "split",
            format!(
                "validation {validation} and test {test} of {windows} windows leave none for training; use smaller \
                 shares or more samples"
            ),
        ),
        _ => Ok(()),
    }
}

/// Refuses a dataset for the test that can't be simulated or is that for training, or that leaves no episodes for
/// training.
fn test_dataset(experiment: &Experiment, test: &TestDataset) -> Result<(), Fault> {
    let Experiment { split, simulation, scenarios, .. } = experiment;
    if split.by != Division::Episode || split.has_groups() {
        return fault(
            "test",
            format!(
                "a split by {} takes the test from each episode of the run's own dataset; use split.by: episode, or \
                 leave out 'test'",
                split.by
            ),
        );
    }
    if test.dataset.is_some() && (test.episodes, test.seed) != (TestDataset::default().episodes, 0) {
        return fault(
            "test",
            "an imported dataset has episodes of its own; leave out test.episodes and test.seed",
        );
    }
    for origin in scenarios {
        match (experiment.world(origin), &test.dataset) {
            (None, None) => {
                return fault(
                    "test",
                    format!(
                        "'{origin}' is imported, so no episodes can be simulated for its test; name another imported \
                         dataset as test.dataset, or leave out 'test'"
                    ),
                );
            }
            (Some(_), Some(_)) => {
                return fault(
                    "test.dataset",
                    format!("'{origin}' is simulated, and so is its test; leave out test.dataset"),
                );
            }
            (None, Some(name)) if name == origin.name() => {
                return fault(
                    "test.dataset",
                    format!(
                        "'{origin}' would be for training and for the test; name another dataset, or leave out 'test', \
                         so that split.test says which of its episodes are for the test"
                    ),
                );
            }
            _ => {}
        }
    }
    if test.factors.is_some() && test.dataset.is_some() {
        return fault(
            "test.factors",
            "the episodes of an imported dataset are as they are; leave out test.factors",
        );
    }
    if let Some(world) = &test.world {
        test_world(experiment, test, world)?;
    }
    for (index, name) in test.factors.iter().flatten().enumerate() {
        let simulated_in = test.world.as_ref().map_or(&scenarios[..], std::slice::from_ref);
        for world in simulated_in.iter().filter_map(|origin| experiment.world(origin)) {
            let names: Vec<&str> = world.file().factors.iter().map(|(name, _)| name).collect();
            if !names.contains(&name.as_str()) {
                let message = unknown("factor", name, "test.factors", &names, str::to_owned);
                let path = format!("test.factors.{index}");
                return fault(path, format!("{message} in the world {}", world.scenario()));
            }
        }
    }
    let episodes = simulation.episodes as usize;
    if test.dataset.is_none() && split.counts(episodes, true).is_none() {
        return fault(
            "simulation.episodes",
            format!(
                "validation {} of {episodes} episodes leaves none for training; use a smaller share or more episodes, \
                 at least 2",
                split.validation
            ),
        );
    }
    Ok(())
}

/// Refuses a world of the test that is none, or that lacks a modality of the runs.
fn test_world(experiment: &Experiment, test: &TestDataset, origin: &Origin) -> Result<(), Fault> {
    let path = "test.world";
    if test.dataset.is_some() {
        return fault(path, "the episodes of an imported dataset are in no world; leave out test.world");
    }
    if let Some(message) = unknown_world(origin, "world", path) {
        return fault(path, message + ", or the path of a world file");
    }
    let Some(world) = experiment.world(origin) else {
        let message = format!(
            "'{origin}' is an imported dataset; name a built-in world, or the path of a world file. The test of runs \
             on imported datasets is test.dataset"
        );
        return fault(path, message);
    };
    let Experiment { input, output, probes, .. } = experiment;
    let names: Vec<&str> = world.modalities().map(Modality::name).collect();
    let is_missing = |modality: &&Modality| !names.contains(&modality.name());
    match input.iter().chain(output).chain(probes).find(is_missing) {
        Some(missing) => fault(
            path,
            format!(
                "the world {} has no '{missing}', which the runs use; its modalities are {}",
                world.scenario(),
                names.join(", ")
            ),
        ),
        None => Ok(()),
    }
}
