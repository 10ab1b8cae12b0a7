//! Trained networks as safetensors files: the parameters by name, the normalizers of the training, and a description
//! from which other programs can rebuild the network.

use super::LearningError;
use super::network::Parameters;
use super::network::description::{Description, change_of};
use super::tensors::TensorFile;
use candle_core::{Device, Result as CandleResult, Tensor};
use harness_samples::{Normalizer, Normalizers};
use harness_spec::Modality;
use serde_json::{Map, Value, json};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

/// Key of the network's description in a file's note.
const NETWORK: &str = "network";

/// Writes `parameters`, `normalizers` and the `network`'s description to a sealed file. A failed write leaves no
/// partial file.
pub fn save(
    path: &Path,
    parameters: &Parameters,
    normalizers: &Normalizers,
    network: &Description,
) -> Result<(), LearningError> {
    let mut tensors: HashMap<String, Tensor> =
        parameters.iter().map(|(name, var)| (name.clone(), var.as_tensor().clone())).collect();
    let named = normalizers.modalities.iter().map(|(modality, normalizer)| (modality.name(), normalizer));
    for (name, normalizer) in named.chain([("action", &normalizers.action)]) {
        tensors.insert(format!("scale.{name}.mean"), vector(&normalizer.mean)?);
        tensors.insert(format!("scale.{name}.deviation"), vector(&normalizer.std)?);
        if let Some(minimum) = normalizer.minimum {
            tensors.insert(format!("scale.{name}.minimum"), vector(&[minimum])?);
        }
    }
    for (modality, change) in &normalizers.changes {
        tensors.insert(change_of(*modality), vector(&change.std)?);
    }
    TensorFile { tensors, note: Map::from_iter([(NETWORK.to_owned(), json!(network))]) }.write(path)
}

fn vector(values: &[f32]) -> CandleResult<Tensor> {
    Tensor::from_slice(values, values.len(), &Device::Cpu)
}

/// Sets `parameters` from a file that [`save`] has written, and returns its normalizers.
///
/// # Errors
/// When the file is damaged, or a parameter is missing or has another shape. The error names the file. The parameters
/// do not change in that case.
pub fn load(path: &Path, parameters: &Parameters) -> Result<Normalizers, LearningError> {
    let damaged = |reason: String| LearningError::Damaged { path: path.to_owned(), reason };
    let (file, normalizers) = open(path)?;
    let found = parameters.iter().map(|(name, parameter)| Ok((parameter, file.like(name, parameter)?)));
    for (parameter, tensor) in found.collect::<Result<Vec<_>, String>>().map_err(damaged)? {
        parameter.set(&tensor)?;
    }
    Ok(normalizers)
}

/// Reads a file that [`save`] has written, with its normalizers.
///
/// # Errors
/// When the file is damaged. The error names it.
pub fn open(path: &Path) -> Result<(TensorFile, Normalizers), LearningError> {
    let file = TensorFile::read(path)?;
    let normalizer = |name: &str| -> Option<Normalizer> {
        let part = |part: &str| -> Option<Vec<f32>> {
            file.tensors.get(&format!("scale.{name}.{part}"))?.to_vec1().ok()
        };
        let minimum = part("minimum").and_then(|minimum| minimum.first().copied());
        Some(Normalizer { mean: part("mean")?, std: part("deviation")?, minimum })
    };
    let names = file.tensors.keys().filter_map(|key| key.strip_prefix("scale.")?.strip_suffix(".mean"));
    let modalities = names.filter(|name| *name != "action").filter_map(Modality::new);
    let modalities = modalities.filter_map(|modality| Some((modality, normalizer(modality.name())?)));
    let modalities: BTreeMap<Modality, Normalizer> = modalities.collect();
    let change = |(&modality, scale): (&Modality, &Normalizer)| {
        let std = file.tensors.get(&change_of(modality))?.to_vec1().ok()?;
        Some((modality, Normalizer { mean: vec![0.0; scale.mean.len()], std, minimum: None }))
    };
    let changes = modalities.iter().filter_map(change).collect();
    let levels = |output: &Value| {
        let levels = serde_json::from_value(output["distribution"]["levels"].clone()).ok()?;
        Some((Modality::new(output["name"].as_str()?)?, levels))
    };
    let outputs = file.note.get(NETWORK).and_then(|network| network["outputs"].as_array());
    let levels = outputs.into_iter().flatten().filter_map(levels).collect();
    let action = normalizer("action").ok_or_else(|| LearningError::Damaged {
        path: path.to_owned(),
        reason: "it has no scale of the action".into(),
    })?;
    Ok((file, Normalizers { modalities, action, changes, levels }))
}
