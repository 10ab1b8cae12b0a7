//! Trained networks as safetensors files: parameters by name, and the scales that they were trained with.

use super::LearningError;
use super::network::Parameters;
use super::tensors::TensorFile;
use crate::{Scale, Standard};
use candle_core::{Device, Result as CandleResult, Tensor};
use harness_spec::Modality;
use serde_json::Map;
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

/// Writes `parameters` and `standard`, sealed, whole or not at all.
pub fn save(path: &Path, parameters: &Parameters, standard: &Standard) -> Result<(), LearningError> {
    let mut tensors: HashMap<String, Tensor> =
        parameters.iter().map(|(name, var)| (name.clone(), var.as_tensor().clone())).collect();
    let scales = standard.scales.iter().map(|(modality, scale)| (modality.name(), scale));
    for (name, scale) in scales.chain([("action", &standard.action)]) {
        tensors.insert(format!("scale.{name}.mean"), vector(&scale.mean)?);
        tensors.insert(format!("scale.{name}.deviation"), vector(&scale.deviation)?);
        if let Some(minimum) = scale.minimum {
            tensors.insert(format!("scale.{name}.minimum"), vector(&[minimum])?);
        }
    }
    TensorFile { tensors, note: Map::new() }.write(path)
}

fn vector(values: &[f32]) -> CandleResult<Tensor> {
    Tensor::from_slice(values, values.len(), &Device::Cpu)
}

/// Sets `parameters` from a file that [`save`] wrote, and returns its scales.
///
/// # Errors
/// When the file is not as it was written, or lacks a parameter or has it in another shape; it is named, and the
/// parameters are left as they were.
pub fn load(path: &Path, parameters: &Parameters) -> Result<Standard, LearningError> {
    let damaged = |reason: String| LearningError::Damaged { path: path.to_owned(), reason };
    let file = TensorFile::read(path)?;
    let found = parameters.iter().map(|(name, parameter)| Ok((parameter, file.like(name, parameter)?)));
    for (parameter, tensor) in found.collect::<Result<Vec<_>, String>>().map_err(damaged)? {
        parameter.set(&tensor)?;
    }
    let scale = |name: &str| -> Option<Scale> {
        let part = |part: &str| -> Option<Vec<f32>> {
            file.tensors.get(&format!("scale.{name}.{part}"))?.to_vec1().ok()
        };
        let minimum = part("minimum").and_then(|minimum| minimum.first().copied());
        Some(Scale { mean: part("mean")?, deviation: part("deviation")?, minimum })
    };
    let names = file.tensors.keys().filter_map(|key| key.strip_prefix("scale.")?.strip_suffix(".mean"));
    let modalities = names.filter(|name| *name != "action").filter_map(Modality::new);
    let scales = modalities.filter_map(|modality| Some((modality, scale(modality.name())?)));
    let scales: BTreeMap<Modality, Scale> = scales.collect();
    let action = scale("action").ok_or_else(|| damaged("no scale of the action".into()))?;
    Ok(Standard { scales, action })
}
