//! Batches of frames that are computed one frame at a time, when they are needed.
//!
//! A batch of 1024 normalized frames takes 50 MB. An op that asks for one frame at a time keeps it in the processor's
//! cache, and no batch has to be assembled before.

use candle_core::{Device, Result, Tensor};
use harness_samples::{Normalizers, Sample, Samples};
use harness_spec::{IMAGE_CHANNELS, Modality};
use std::sync::Arc;

/// A batch of normalized frames, `[channels, rows, columns]` each.
pub trait Frames: Send + Sync {
    /// Returns the number of frames in the batch.
    fn batch(&self) -> usize;
    /// Returns the number of channels of a frame.
    fn channels(&self) -> usize;
    /// Returns the rows and columns of a frame in pixels.
    fn size(&self) -> [usize; 2];
    /// Writes frame `index`, `[channels, rows, columns]`, to `frame`.
    fn write(&self, index: usize, frame: &mut [f32]);

    /// Returns the number of values of a frame.
    fn frame_len(&self) -> usize {
        let [rows, columns] = self.size();
        self.channels() * rows * columns
    }

    /// Returns the whole batch as a tensor `[batch, channels, rows, columns]`.
    ///
    /// # Errors
    /// When the tensor can't be created on the device.
    fn tensor(&self, device: &Device) -> Result<Tensor> {
        let mut values = vec![0.0; self.batch() * self.frame_len()];
        for (index, frame) in values.chunks_exact_mut(self.frame_len()).enumerate() {
            self.write(index, frame);
        }
        let [rows, columns] = self.size();
        Tensor::from_vec(values, (self.batch(), self.channels(), rows, columns), device)
    }
}

/// Frames that are in memory as `f32`, `[batch, channels, rows, columns]`.
pub struct DenseFrames {
    values: Vec<f32>,
    channels: usize,
    size: [usize; 2],
}

impl DenseFrames {
    /// Copies the values of a tensor `[batch, channels, rows, columns]`.
    ///
    /// # Errors
    /// When the tensor has another number of dimensions.
    pub fn new(frames: &Tensor) -> Result<Self> {
        let (_, channels, rows, columns) = frames.dims4()?;
        Ok(Self::from_values(frames.flatten_all()?.to_vec1()?, channels, [rows, columns]))
    }

    /// Takes values `[batch, channels, rows, columns]`. The size is that of a frame, its rows and columns.
    pub fn from_values(values: Vec<f32>, channels: usize, size: [usize; 2]) -> Self {
        Self { values, channels, size }
    }
}

impl Frames for DenseFrames {
    fn batch(&self) -> usize {
        self.values.len() / self.frame_len()
    }
    fn channels(&self) -> usize {
        self.channels
    }
    fn size(&self) -> [usize; 2] {
        self.size
    }
    fn write(&self, index: usize, frame: &mut [f32]) {
        frame.copy_from_slice(&self.values[index * self.frame_len()..][..self.frame_len()]);
    }
}

/// Frames that are averaged over squares of pixels.
pub struct Averaged {
    frames: Arc<dyn Frames>,
    /// Side of a square in pixels.
    by: usize,
}

impl Averaged {
    /// Averages `frames` over squares with a side of `by` pixels, which must divide the frames' rows and columns.
    /// Returns `frames` if `by` is 1.
    pub fn over(frames: Arc<dyn Frames>, by: usize) -> Arc<dyn Frames> {
        if by == 1 { frames } else { Arc::new(Self { frames, by }) }
    }
}

impl Frames for Averaged {
    fn batch(&self) -> usize {
        self.frames.batch()
    }
    fn channels(&self) -> usize {
        self.frames.channels()
    }
    fn size(&self) -> [usize; 2] {
        self.frames.size().map(|side| side / self.by)
    }
    fn write(&self, index: usize, frame: &mut [f32]) {
        let mut whole = vec![0.0; self.frames.frame_len()];
        self.frames.write(index, &mut whole);
        let ([fine_height, fine_width], [height, width]) = (self.frames.size(), self.size());
        frame.fill(0.0);
        for (row, values) in whole.chunks_exact(fine_width).enumerate() {
            let (channel, row) = (row / fine_height, row % fine_height / self.by);
            let averaged = &mut frame[(channel * height + row) * width..][..width];
            for (average, square) in averaged.iter_mut().zip(values.chunks_exact(self.by)) {
                *average += square.iter().sum::<f32>();
            }
        }
        let factor = 1.0 / (self.by * self.by) as f32;
        frame.iter_mut().for_each(|value| *value *= factor);
    }
}

/// Consecutive frames of a batch.
struct Part {
    frames: Arc<dyn Frames>,
    first: usize,
    batch: usize,
}

/// Returns `batch` frames from the frame `first` on.
pub fn part(frames: &Arc<dyn Frames>, first: usize, batch: usize) -> Arc<dyn Frames> {
    let frames = frames.clone();
    if batch == frames.batch() { frames } else { Arc::new(Part { frames, first, batch }) }
}

impl Frames for Part {
    fn batch(&self) -> usize {
        self.batch
    }
    fn channels(&self) -> usize {
        self.frames.channels()
    }
    fn size(&self) -> [usize; 2] {
        self.frames.size()
    }
    fn write(&self, index: usize, frame: &mut [f32]) {
        self.frames.write(self.first + index, frame);
    }
}

/// Several images of the same size, stacked by channel.
struct Stacked(Vec<Arc<dyn Frames>>);

/// Stacks images of the same size by channel. A single image is returned as it is.
///
/// # Panics
/// When there are none.
pub fn stacked(mut images: Vec<Arc<dyn Frames>>) -> Arc<dyn Frames> {
    if images.len() == 1 { images.remove(0) } else { Arc::new(Stacked(images)) }
}

impl Frames for Stacked {
    fn batch(&self) -> usize {
        self.0[0].batch()
    }
    fn channels(&self) -> usize {
        self.0.iter().map(|image| image.channels()).sum()
    }
    fn size(&self) -> [usize; 2] {
        self.0[0].size()
    }
    fn write(&self, index: usize, frame: &mut [f32]) {
        let mut rest = frame;
        for image in &self.0 {
            let (own, others) = rest.split_at_mut(image.frame_len());
            image.write(index, own);
            rest = others;
        }
    }
}

/// Normalized frames of chosen samples, computed one at a time.
pub struct SampleFrames {
    samples: Arc<Samples>,
    normalizers: Arc<Normalizers>,
    modality: Modality,
    size: [usize; 2],
    at: Vec<Sample>,
}

impl SampleFrames {
    /// Returns the frames of an image at the samples `at`; `None` for a vector.
    pub fn new(
        samples: &Arc<Samples>,
        normalizers: &Arc<Normalizers>,
        at: &[Sample],
        modality: Modality,
    ) -> Option<Self> {
        let size = samples.layout()[modality].size()?;
        samples.prefetch(modality, at);
        let (samples, normalizers) = (samples.clone(), normalizers.clone());
        Some(Self { samples, normalizers, modality, size, at: at.to_vec() })
    }
}

impl Frames for SampleFrames {
    fn batch(&self) -> usize {
        self.at.len()
    }

    fn channels(&self) -> usize {
        IMAGE_CHANNELS
    }

    fn size(&self) -> [usize; 2] {
        self.size
    }

    fn write(&self, index: usize, frame: &mut [f32]) {
        let (sample, scale) = (self.at[index], &self.normalizers.modalities[&self.modality]);
        let now = self.samples.frame_bytes(self.modality, sample);
        let normalized = scale.of_steps();
        if self.samples.layout()[self.modality].difference_of.is_none() {
            for ((value, now), mean) in frame.iter_mut().zip(now).zip(&scale.mean) {
                *value = normalized(f32::from(*now), *mean);
            }
        } else {
            let before = self.samples.previous_frame_bytes(self.modality, sample);
            for (((value, now), before), mean) in frame.iter_mut().zip(now).zip(before).zip(&scale.mean) {
                *value = normalized(f32::from(*now) - f32::from(*before), *mean);
            }
        }
    }
}
