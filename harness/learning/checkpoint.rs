//! Trained networks as safetensors files: parameters by name, and the scales that they were trained with.

use super::LearningError;
use super::network::Parameters;
use crate::dataset::{Scale, Standard};
use crate::files::write_whole;
use crate::spec::Modality;
use candle_core::{Device, Result as CandleResult, Tensor};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

/// Writes `parameters` and `standard`, whole or not at all.
pub fn save(path: &Path, parameters: &Parameters, standard: &Standard) -> Result<(), LearningError> {
    let mut tensors: HashMap<String, Tensor> =
        parameters.iter().map(|(name, var)| (name.clone(), var.as_tensor().clone())).collect();
    let scales = standard.scales.iter().map(|(modality, scale)| (modality.name(), scale));
    for (name, scale) in scales.chain([("action", &standard.action)]) {
        tensors.insert(format!("scale.{name}.mean"), vector(&scale.mean)?);
        tensors.insert(format!("scale.{name}.deviation"), vector(&scale.deviation)?);
    }
    write_whole(path, |file| candle_core::safetensors::save(&tensors, file).map_err(std::io::Error::other))?;
    Ok(())
}

fn vector(values: &[f32]) -> CandleResult<Tensor> {
    Tensor::from_slice(values, values.len(), &Device::Cpu)
}

/// Sets `parameters` from a file that [`save`] wrote, and returns its scales.
///
/// # Errors
/// When the file can't be read, or lacks a parameter or has it in another shape; it is named.
pub fn load(path: &Path, parameters: &Parameters) -> Result<Standard, LearningError> {
    let damaged = |reason: String| LearningError::Damaged { path: path.to_owned(), reason };
    let tensors =
        candle_core::safetensors::load(path, &Device::Cpu).map_err(|error| damaged(error.to_string()))?;
    for (name, parameter) in parameters {
        let tensor = tensors.get(name).ok_or_else(|| damaged(format!("no parameter '{name}'")))?;
        if tensor.shape() != parameter.shape() {
            return Err(damaged(format!("'{name}' is {:?}, not {:?}", tensor.shape(), parameter.shape())));
        }
        parameter.set(&tensor.to_device(parameter.device())?)?;
    }
    let scale = |name: &str| -> Option<Scale> {
        let part = |part: &str| tensors.get(&format!("scale.{name}.{part}"))?.to_vec1().ok();
        Some(Scale { mean: part("mean")?, deviation: part("deviation")? })
    };
    let scales = Modality::ALL.iter().filter_map(|modality| Some((*modality, scale(modality.name())?)));
    let scales: BTreeMap<Modality, Scale> = scales.collect();
    let action = scale("action").ok_or_else(|| damaged("no scale of the action".into()))?;
    Ok(Standard { scales, action })
}
