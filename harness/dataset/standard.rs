//! Standardisation with the training set's statistics, and batches of standardised values.

use super::frames::Frames;
use super::samples::{FRAME_PLANE, Samples};
use crate::spec::{ARM_JOINTS, Action, FRAME_LEN, FRAME_SIDE, Modality};
use candle_core::{Device, Result, Tensor};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Mean and deviation of one modality.
#[derive(Debug, Clone, PartialEq)]
pub struct Scale {
    /// One a value; `[channel, row, column]` for frames.
    pub mean: Vec<f32>,
    /// One a value for vectors, a single one for frames.
    pub deviation: Vec<f32>,
}

impl Scale {
    fn deviation(&self, index: usize) -> f32 {
        self.deviation[if self.deviation.len() == 1 { 0 } else { index }]
    }

    /// To standardised values, in place: `values` `[n, width]` in physical units.
    pub fn standardise(&self, values: &mut [f32]) {
        for row in values.chunks_exact_mut(self.mean.len()) {
            for (index, (value, mean)) in row.iter_mut().zip(&self.mean).enumerate() {
                *value = (*value - mean) / self.deviation(index);
            }
        }
    }

    /// Back to physical units, in place: `values` `[n, width]`.
    pub fn restore(&self, values: &mut [f32]) {
        for row in values.chunks_exact_mut(self.mean.len()) {
            for (index, (value, mean)) in row.iter_mut().zip(&self.mean).enumerate() {
                *value = *value * self.deviation(index) + mean;
            }
        }
    }
}

/// The scales of every modality that an experiment uses, and of the action.
#[derive(Debug, Clone, PartialEq)]
pub struct Standard {
    pub scales: BTreeMap<Modality, Scale>,
    pub action: Scale,
}

/// Running sums for a mean and a deviation, value by value.
struct Moments {
    count: f64,
    sum: Vec<f64>,
    square: Vec<f64>,
}

impl Moments {
    fn new(width: usize) -> Self {
        Self { count: 0.0, sum: vec![0.0; width], square: vec![0.0; width] }
    }

    fn add(&mut self, values: impl Iterator<Item = f32>) {
        self.count += 1.0;
        for ((value, sum), square) in values.zip(&mut self.sum).zip(&mut self.square) {
            let value = f64::from(value);
            *sum += value;
            *square += value * value;
        }
    }

    fn means(&self) -> Vec<f32> {
        self.sum.iter().map(|sum| (sum / self.count) as f32).collect()
    }

    fn variances(&self) -> impl Iterator<Item = f64> {
        self.sum.iter().zip(&self.square).map(|(sum, square)| {
            let mean = sum / self.count;
            (square / self.count - mean * mean).max(0.0)
        })
    }

    /// One deviation a value.
    fn vector_scale(&self) -> Scale {
        Scale { mean: self.means(), deviation: self.variances().map(deviation).collect() }
    }

    /// One mean a pixel, one deviation for all of them.
    fn frame_scale(&self) -> Scale {
        let variance = self.variances().sum::<f64>() / self.sum.len() as f64;
        Scale { mean: self.means(), deviation: vec![deviation(variance)] }
    }
}

/// The square root of a variance; 1 for a value that never changes, which then standardises to zero.
fn deviation(variance: f64) -> f32 {
    let deviation = variance.sqrt() as f32;
    if deviation > 1e-8 { deviation } else { 1.0 }
}

impl Standard {
    /// Statistics of `modalities` and of the action over `transitions`.
    pub fn fit(samples: &Samples, transitions: &[usize], modalities: &[Modality], action: Action) -> Self {
        let scales =
            modalities.iter().map(|modality| (*modality, fit_modality(samples, transitions, *modality)));
        let mut moments = Moments::new(ARM_JOINTS);
        for sample in transitions {
            moments.add(samples.action(action, *sample).into_iter());
        }
        Self { scales: scales.collect(), action: moments.vector_scale() }
    }

    /// A vector `[batch, width]` of several modalities side by side, standardised; `None` if there are none.
    pub fn vectors(
        &self,
        samples: &Samples,
        at: &[usize],
        modalities: &[Modality],
    ) -> Option<Result<Tensor>> {
        let modalities: Vec<Modality> =
            modalities.iter().copied().filter(|modality| !modality.is_frame()).collect();
        let width: usize = modalities.iter().map(|modality| modality.width()).sum();
        if width == 0 {
            return None;
        }
        let mut values = Vec::with_capacity(at.len() * width);
        for sample in at {
            for modality in &modalities {
                let scale = &self.scales[modality];
                let physical =
                    samples.vector(*modality, *sample).iter().zip(&scale.mean).zip(&scale.deviation);
                values.extend(physical.map(|((value, mean), deviation)| (value - mean) / deviation));
            }
        }
        Some(Tensor::from_vec(values, (at.len(), width), &Device::Cpu))
    }

    /// The standardised action `[batch, 3]` of the steps from `at` to the next samples.
    pub fn actions(&self, samples: &Samples, at: &[usize], action: Action) -> Result<Tensor> {
        let scale = &self.action;
        let values = at.iter().flat_map(|sample| {
            let action = samples.action(action, *sample);
            (0..ARM_JOINTS).map(move |joint| (action[joint] - scale.mean[joint]) / scale.deviation[joint])
        });
        Tensor::from_vec(values.collect(), (at.len(), ARM_JOINTS), &Device::Cpu)
    }

    /// The frames of several modalities stacked channel-wise, standardised when read; `None` if there are none.
    pub fn frames(
        &self,
        samples: &Arc<Samples>,
        at: &[usize],
        modalities: &[Modality],
    ) -> Option<Arc<dyn Frames>> {
        let scales: Vec<(Modality, Scale)> = modalities
            .iter()
            .filter(|modality| modality.is_frame())
            .map(|modality| (*modality, self.scales[modality].clone()))
            .collect();
        if scales.is_empty() {
            return None;
        }
        Some(Arc::new(SampleFrames { samples: samples.clone(), at: at.to_vec(), scales }))
    }
}

fn fit_modality(samples: &Samples, transitions: &[usize], modality: Modality) -> Scale {
    let mut moments = Moments::new(modality.width());
    match modality {
        Modality::Vision => {
            for sample in transitions {
                moments.add(samples.frame_bytes(*sample).iter().map(|byte| f32::from(*byte) / 255.0));
            }
            moments.frame_scale()
        }
        Modality::FrameDifference => {
            for sample in transitions {
                moments.add(frame_difference(samples, *sample));
            }
            moments.frame_scale()
        }
        _ => {
            for sample in transitions {
                moments.add(samples.vector(modality, *sample).iter().copied());
            }
            moments.vector_scale()
        }
    }
}

/// What changed in the frame since the sample before, in [-1, 1], `[channel, row, column]`.
pub fn frame_difference(samples: &Samples, sample: usize) -> impl Iterator<Item = f32> {
    let frames = samples.frame_bytes(sample).iter().zip(samples.previous_frame_bytes(sample));
    frames.map(|(now, before)| (f32::from(*now) - f32::from(*before)) / 255.0)
}

/// Standardised frames of chosen samples, made one at a time.
struct SampleFrames {
    samples: Arc<Samples>,
    at: Vec<usize>,
    scales: Vec<(Modality, Scale)>,
}

impl Frames for SampleFrames {
    fn batch(&self) -> usize {
        self.at.len()
    }

    fn channels(&self) -> usize {
        self.scales.len() * FRAME_LEN / FRAME_PLANE
    }

    fn side(&self) -> usize {
        FRAME_SIDE
    }

    fn write(&self, index: usize, frame: &mut [f32]) {
        let sample = self.at[index];
        let now = self.samples.frame_bytes(sample);
        for ((modality, scale), frame) in self.scales.iter().zip(frame.chunks_exact_mut(FRAME_LEN)) {
            let factor = 1.0 / scale.deviation[0];
            let bytes = 1.0 / 255.0;
            if *modality == Modality::Vision {
                for ((value, now), mean) in frame.iter_mut().zip(now).zip(&scale.mean) {
                    *value = (f32::from(*now) * bytes - mean) * factor;
                }
            } else {
                let before = self.samples.previous_frame_bytes(sample);
                for (((value, now), before), mean) in frame.iter_mut().zip(now).zip(before).zip(&scale.mean) {
                    *value = ((f32::from(*now) - f32::from(*before)) * bytes - mean) * factor;
                }
            }
        }
    }
}
