//! The settings of outputs. A spec has them under `outputs`, by output. A run stores them under `training`, by setting.

use super::types::{Experiment, OutputSettings};
use crate::layout::Modality;
use std::collections::BTreeMap;

/// The settings of an output, with the keys under which training stores them.
const STORED: [(&str, &str); 4] = [
    ("predict", "predict"),
    ("loss", "losses"),
    ("distribution", "distributions"),
    ("weight", "loss_weights"),
];

/// Returns the dotted keys of the sections that hold settings of outputs.
pub(super) fn sections() -> impl Iterator<Item = String> {
    let stored = STORED.iter().map(|(_, section)| format!("training.{section}"));
    std::iter::once("outputs".to_owned()).chain(stored)
}

/// Writes the settings of outputs to those of training.
///
/// # Errors
/// When a setting is given in both places. The error has the key at fault and the message.
pub(super) fn store(experiment: &mut Experiment) -> Result<(), (String, String)> {
    fn insert<T>(stored: &mut BTreeMap<Modality, T>, output: Modality, value: Option<T>) -> bool {
        value.is_none_or(|value| stored.insert(output, value).is_none())
    }
    let Experiment { outputs, training, .. } = experiment;
    for (&output, &OutputSettings { predict, loss, distribution, weight }) in &*outputs {
        let stored = [
            insert(&mut training.predict, output, predict),
            insert(&mut training.losses, output, loss),
            insert(&mut training.distributions, output, distribution),
            insert(&mut training.loss_weights, output, weight),
        ];
        if let Some(twice) = stored.iter().position(|is_new| !is_new) {
            let (setting, section) = STORED[twice];
            let path = format!("outputs.{output}.{setting}");
            let message = format!("'training.{section}.{output}' sets it as well; keep only one of them");
            return Err((path, message));
        }
    }
    Ok(())
}

/// Returns the key under `outputs` of a setting that training stores for an output; `None` for other settings.
pub(super) fn written_key(stored: &str) -> Option<String> {
    let (section, output) = stored.strip_prefix("training.")?.split_once('.')?;
    let (setting, _) = STORED.iter().find(|(_, stored)| *stored == section)?;
    Some(format!("outputs.{output}.{setting}"))
}

/// Returns the key under which training stores a setting of an output; `None` for other settings.
pub(super) fn stored_key(written: &str) -> Option<String> {
    let (output, setting) = written.strip_prefix("outputs.")?.split_once('.')?;
    let (_, section) = STORED.iter().find(|(written, _)| *written == setting)?;
    Some(format!("training.{section}.{output}"))
}
