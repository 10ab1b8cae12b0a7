//! A dataset as tensors for a network.

use super::observation::{Observation, Value};
use candle_core::{Device, Result, Tensor};
use harness_ops::frames::SampleFrames;
use harness_samples::{Normalizers, Sample, Samples};
use harness_spec::{Action, Modality};
use std::sync::Arc;

/// A dataset, normalized for a network.
#[derive(Clone)]
pub struct NormalizedData {
    /// The samples, in physical units.
    pub samples: Arc<Samples>,
    /// Means and standard deviations of the modalities and of the action.
    pub normalizers: Arc<Normalizers>,
    /// Which quantity is used as the action.
    pub action: Action,
    /// The device on which tensors are created.
    pub device: Device,
}

impl NormalizedData {
    /// Returns the normalized values of `modalities` at the samples `at`.
    ///
    /// # Errors
    /// When a tensor can't be created on the device.
    pub fn observation(&self, at: &[Sample], modalities: &[Modality]) -> Result<Observation> {
        let value = |&modality: &Modality| {
            let value = match SampleFrames::new(&self.samples, &self.normalizers, at, modality) {
                Some(frames) => Value::Frames(Arc::new(frames)),
                None => {
                    let values = self.normalizers.vectors(&self.samples, at, &[modality]);
                    Value::Vector(self.table(values, at.len())?)
                }
            };
            Ok((modality, value))
        };
        modalities.iter().map(value).collect()
    }

    /// Returns `values` as a matrix of `rows` rows.
    fn table(&self, values: Vec<f32>, rows: usize) -> Result<Tensor> {
        let columns = values.len() / rows;
        Tensor::from_vec(values, (rows, columns), &Device::Cpu)?.to_device(&self.device)
    }

    /// Returns the normalized actions, `[batch, elements]`, between each sample in `at` and the next one.
    ///
    /// # Errors
    /// When a tensor can't be created on the device.
    pub fn actions(&self, at: &[Sample]) -> Result<Tensor> {
        self.table(self.normalizers.actions(&self.samples, at, self.action), at.len())
    }
}
