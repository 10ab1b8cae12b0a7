//! Which settings the text of a run or a dataset contains.

use crate::yaml::join;
use serde_json::Value as Json;

/// Sections and settings that are stored even if they have their default. They are those from before defaults were left
/// out. The name of a run or a dataset contains the hash of what is stored, so this list never changes.
const ALWAYS: [&str; 23] = [
    "network",
    "network.hidden",
    "network.preset",
    "simulation",
    "simulation.actuation_seconds",
    "simulation.actuations_per_episode",
    "simulation.episodes",
    "simulation.sample_rate_hz",
    "simulation.seed",
    "split",
    "split.test",
    "split.validation",
    "training",
    "training.batch_size",
    "training.device",
    "training.epochs",
    "training.kl_weight",
    "training.learning_rate",
    "training.loss_weights",
    "training.patience",
    "training.precision",
    // Of a window that is not the default.
    "window.context",
    "window.horizon",
];

/// Returns the settings at a dotted path without those that have their default, except [`ALWAYS`].
pub(super) fn stored(path: &str, mut settings: Json, defaults: &Json) -> Json {
    if let (Some(own), Some(defaults)) = (settings.as_object_mut(), defaults.as_object()) {
        for (key, default) in defaults {
            let path = join(path, key);
            match own.get_mut(key) {
                Some(value) if value == default && !ALWAYS.contains(&path.as_str()) => {
                    drop(own.shift_remove(key))
                }
                Some(value) => *value = stored(&path, value.take(), default),
                None => {}
            }
        }
    }
    settings
}
