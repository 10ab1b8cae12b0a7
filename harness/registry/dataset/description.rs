//! The description of a dataset (`dataset.json`), and the dataset's name, which contains the description's hash.

use super::DatasetError;
use harness_samples::Labels;
use harness_shared::seal::hex;
use harness_spec::{Layout, Scenario, Simulation, Split};
use serde::Deserialize;
use serde_json::json;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

/// Version of the recordings. It is raised whenever the same spec would give other recordings than before.
pub(super) const FORMAT: u32 = 2;

/// Returns a simulated dataset's name: its scenario and the hash of what determines its content.
pub(super) fn identify(scenario: Scenario, description: &serde_json::Value) -> String {
    let mut identity = description.clone();
    // The number of episodes does not change their contents, so a longer dataset extends a shorter one.
    identity["simulation"]["episodes"].take();
    // The layout and the model's text follow from the rest of the description.
    if let Some(fields) = identity.as_object_mut() {
        fields.remove("layout");
        fields.remove(MODEL_TEXT);
    }
    named_by_hash(scenario.name(), identity)
}

/// Returns `name` followed by the first digits of the hash of `identity`. The order of keys does not matter.
fn named_by_hash(name: &str, mut identity: serde_json::Value) -> String {
    identity.sort_all_objects();
    let hash = hex(&Sha256::digest(identity.to_string()));
    format!("{name}-{}", &hash[..16])
}

/// The file with the compiled model of a simulated dataset, as MJCF. Datasets of earlier versions lack it.
pub const MODEL: &str = "model.xml";

/// The key of a description with the SHA-256 of the file [`MODEL`]. Descriptions of earlier versions lack it.
pub(super) const MODEL_TEXT: &str = "model_xml_sha256";

/// The contents of `dataset.json`.
pub(super) struct Description(pub serde_json::Value);

impl Description {
    pub const FILE: &str = "dataset.json";

    /// Reads the description in a dataset's folder. The error says why it can't be read.
    pub fn read(folder: &Path) -> Result<Self, String> {
        let bytes = std::fs::read(folder.join(Self::FILE)).map_err(|error| error.to_string())?;
        serde_json::from_slice(&bytes).map(Self).map_err(|error| error.to_string())
    }

    /// Why the model's file in a dataset's folder is not the described one; `None` if it is, or if the description
    /// does not say which it is.
    pub fn fault_of_model(&self, folder: &Path) -> Option<String> {
        let sha256 = self.0[MODEL_TEXT].as_str()?;
        match std::fs::read(folder.join(MODEL)) {
            Ok(bytes) if hex(&Sha256::digest(&bytes)) == sha256 => None,
            Ok(_) => Some("it has changed since it was written: its SHA-256 differs".into()),
            Err(error) => Some(error.to_string()),
        }
    }

    /// Whether this version of the program reads and writes the dataset's format.
    pub fn is_current(&self) -> bool {
        self.0["format"] == FORMAT
    }

    /// Returns the scenario and the settings of a simulated dataset; `None` if this does not describe the dataset
    /// `name`. The name is a hash of everything except the number of episodes.
    pub fn simulated(&self, name: &str) -> Option<(Scenario, Simulation)> {
        let scenario = Scenario::new(self.0["scenario"].as_str()?)?;
        let simulation = serde_json::from_value(self.0["simulation"].clone()).ok()?;
        (identify(scenario, &self.0) == name).then_some((scenario, simulation))
    }

    /// Returns the layout of the samples of a simulated dataset.
    pub fn layout(&self) -> Result<Arc<Layout>, String> {
        let layout =
            Layout::deserialize(&self.0["layout"]).map_err(|error| format!("its layout: {error}"))?;
        Ok(Arc::new(layout))
    }

    /// Returns the description of an imported dataset; `None` if this does not describe the dataset `name`. The name
    /// ends in a hash of the content.
    pub fn imported(&self, name: &str) -> Option<Content> {
        let content = self.0.get("imported")?;
        let identity = json!({ "format": FORMAT, "imported": content });
        let own_name = content["name"].as_str()?;
        let described = self.is_current() && named_by_hash(own_name, identity) == name;
        serde_json::from_value(content.clone()).ok().filter(|_| described)
    }

    /// Returns what the import says of itself.
    pub fn import_report(&self) -> ImportReport {
        ImportReport::deserialize(&self.0["import"]).unwrap_or_default()
    }
}

/// What an import says of itself in `dataset.json`, for people. Datasets of earlier versions say nothing.
#[derive(Debug, Clone, Default, Deserialize)]
pub struct ImportReport {
    /// Where each modality is from.
    pub sources: BTreeMap<String, String>,
    /// The times of the streams, as a table with its head.
    pub streams: Vec<Vec<String>>,
    /// What was left out or changed, with how much.
    pub cleaned: Vec<String>,
}

/// Returns the layout of the samples of the dataset in a folder. The dataset can be simulated or imported.
pub fn layout_of(folder: &Path) -> Result<Arc<Layout>, DatasetError> {
    let described = || {
        let description = Description::read(folder)?;
        let name = folder.file_name().unwrap_or_default().to_string_lossy();
        match description.imported(&name) {
            Some(content) => Ok(Arc::new(content.layout)),
            None => description.layout(),
        }
    };
    described().map_err(|problem| DatasetError::Damaged { path: folder.join(Description::FILE), problem })
}

/// Returns whether the dataset in a folder was imported; false as well if its description can't be read.
pub fn is_imported(folder: &Path) -> bool {
    Description::read(folder).is_ok_and(|description| description.0.get("imported").is_some())
}

/// The description of an imported dataset in `dataset.json`. The dataset's name contains its hash.
#[derive(Debug, Clone, Deserialize)]
pub(super) struct Content {
    pub sample_rate_hz: f64,
    /// The layout of the samples.
    pub layout: Layout,
    episodes: Vec<ImportedEpisode>,
    /// The split of runs that ask for no other one.
    split: Option<Split>,
}

#[derive(Debug, Clone, Deserialize)]
struct ImportedEpisode {
    samples: u32,
    #[serde(default)]
    labels: BTreeMap<String, Option<String>>,
}

impl Content {
    /// Returns what is known about the episodes.
    pub fn labels(&self) -> Labels {
        let episodes = self.episodes.iter().map(|episode| episode.labels.clone()).collect();
        Labels { episodes, split: self.split.clone() }
    }

    /// Returns the number of samples of each episode.
    pub fn samples(&self) -> impl ExactSizeIterator<Item = usize> {
        self.episodes.iter().map(|episode| episode.samples as usize)
    }
}
