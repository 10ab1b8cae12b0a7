//! Trained networks as safetensors files: the parameters by name, and the normalizers of the training.

use super::LearningError;
use super::network::Parameters;
use super::tensors::TensorFile;
use crate::{Normalizer, Normalizers};
use candle_core::{Device, Result as CandleResult, Tensor};
use harness_spec::Modality;
use serde_json::Map;
use std::collections::HashMap;
use std::path::Path;

/// Writes `parameters` and `normalizers` to a sealed file. A failed write leaves no partial file.
pub fn save(path: &Path, parameters: &Parameters, normalizers: &Normalizers) -> Result<(), LearningError> {
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
    TensorFile { tensors, note: Map::new() }.write(path)
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
    let file = TensorFile::read(path)?;
    let found = parameters.iter().map(|(name, parameter)| Ok((parameter, file.like(name, parameter)?)));
    for (parameter, tensor) in found.collect::<Result<Vec<_>, String>>().map_err(damaged)? {
        parameter.set(&tensor)?;
    }
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
    let action = normalizer("action").ok_or_else(|| damaged("it has no scale of the action".into()))?;
    Ok(Normalizers { modalities: modalities.collect(), action })
}
