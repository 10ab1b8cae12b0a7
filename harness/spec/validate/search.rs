//! The rules of a search.

use super::{Fault, fault};
use crate::outputs::written_key;
use crate::search::{Halving, Objective, Search};
use crate::types::{Experiment, Settings};
use crate::vary::VARY;
use crate::yaml::unknown;
use serde_json::Value as Json;

/// Refuses a search whose trials can't be drawn or compared.
pub fn validate(experiment: &Experiment) -> Result<(), Fault> {
    let Some(search) = &experiment.search else { return Ok(()) };
    search.check().or_else(|(path, message)| fault(format!("search.{path}"), message))?;
    for key in search.space.keys() {
        let is_in = |settings: &Settings| settings.contains_key(key);
        let has_label = |axis: &Json| {
            axis.as_object().is_some_and(|labels| labels.values().any(|one| one.get(key).is_some()))
        };
        let place = if experiment.vary.contains_key(key) {
            VARY.to_owned()
        } else if experiment.readings.iter().any(|reading| is_in(&reading.settings)) {
            "readings".to_owned()
        } else if let Some((axis, _)) = experiment.vary.iter().find(|(_, axis)| has_label(axis)) {
            format!("{VARY}.{axis}")
        } else {
            continue;
        };
        return fault(
            format!("search.space.{key}"),
            format!("'{key}' is also in '{place}'; leave it out of one of them"),
        );
    }
    objective(experiment, search)?;
    search.halving.as_ref().map_or(Ok(()), |rungs| halving(experiment, search, rungs))
}

/// Refuses an objective that is no term of the loss, or that means something else in each trial.
fn objective(experiment: &Experiment, search: &Search) -> Result<(), Fault> {
    let term = search.objective.term.as_str();
    let outputs = experiment.output.iter().map(|modality| modality.name());
    let terms: Vec<&str> = outputs.chain([Objective::TOTAL]).collect();
    if !terms.contains(&term) {
        let path = "search.objective.term";
        return fault(path, unknown("term", term, path, &terms, str::to_owned));
    }
    let changes = |key: &str| {
        let own = written_key(key).unwrap_or_else(|| key.to_owned());
        match (own.strip_prefix("outputs.").and_then(|own| own.split_once('.')), term) {
            (None, Objective::TOTAL) => own == "training.kl_weight",
            (Some(_), Objective::TOTAL) => true,
            (Some((modality, setting)), output) => modality == output && setting != "weight",
            (None, _) => false,
        }
    };
    let Some(key) = search.space.keys().find(|key| changes(key)) else { return Ok(()) };
    let others: Vec<&str> =
        terms.into_iter().filter(|other| *other != term && *other != Objective::TOTAL).collect();
    let other = match others.as_slice() {
        [] => String::new(),
        others => format!(", or set search.objective.term to {}", others.join(" or ")),
    };
    fault(
        format!("search.space.{key}"),
        format!(
            "the objective '{term}' depends on '{key}', so trials can't be compared by it; leave '{key}' out{other}"
        ),
    )
}

/// Refuses rungs that no training has, and trials that do not have the same rungs.
fn halving(experiment: &Experiment, search: &Search, halving: &Halving) -> Result<(), Fault> {
    let (least, epochs) = (halving.min_epochs, experiment.training.epochs);
    if least >= epochs {
        return fault(
            "search.halving.min_epochs",
            format!(
                "{least} epochs are not less than training.epochs, {epochs}, so no trial would be stopped; use fewer"
            ),
        );
    }
    if experiment.training.last_epoch.is_some() {
        return fault("training.last_epoch", "successive halving sets it; leave it out");
    }
    let of_length =
        ["training.epochs", "training.last_epoch"].into_iter().find(|key| search.space.contains_key(*key));
    of_length.map_or(Ok(()), |key| {
        let message = format!("halving compares trials after the same epochs; leave '{key}' out");
        fault(format!("search.space.{key}"), message)
    })
}
