//! Batches of frames that are computed one frame at a time, when they are needed.
//!
//! A batch of 1024 normalized frames takes 50 MB. An op that asks for one frame at a time keeps it in the processor's
//! cache, and no batch has to be assembled before.

use crate::{Values, input};
use candle_core::{Device, Result, Tensor};
use harness_samples::{Normalizers, Sample, Samples};
use harness_spec::{IMAGE_CHANNELS, Modality};
#[cfg(feature = "cuda")]
use std::collections::{BTreeMap, btree_map::Entry};
#[cfg(feature = "cuda")]
use std::sync::Mutex;
use std::sync::{Arc, OnceLock};

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
    fn tensor(&self, device: &Device) -> Result<Tensor>;
}

/// Writes all frames of a batch to a tensor `[batch, channels, rows, columns]`.
fn dense(frames: &(impl Frames + ?Sized), device: &Device) -> Result<Tensor> {
    let mut values = vec![0.0; frames.batch() * frames.frame_len()];
    for (index, frame) in values.chunks_exact_mut(frames.frame_len()).enumerate() {
        frames.write(index, frame);
    }
    let [rows, columns] = frames.size();
    Tensor::from_vec(values, (frames.batch(), frames.channels(), rows, columns), device)
}

/// Frames that are in memory as `f32`, `[batch, channels, rows, columns]`.
pub struct DenseFrames {
    values: Vec<f32>,
    channels: usize,
    size: [usize; 2],
    /// The same values on the device that first asked for them.
    copied: OnceLock<Tensor>,
}

impl DenseFrames {
    /// Copies the values of a tensor `[batch, channels, rows, columns]`.
    pub fn new(frames: &Tensor) -> Result<Self> {
        let (_, channels, rows, columns) = frames.dims4()?;
        Ok(Self::from_values(frames.flatten_all()?.to_vec1()?, channels, [rows, columns]))
    }

    /// Takes values `[batch, channels, rows, columns]`. The size is that of a frame, its rows and columns.
    pub fn from_values(values: Vec<f32>, channels: usize, size: [usize; 2]) -> Self {
        Self { values, channels, size, copied: OnceLock::new() }
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
    fn tensor(&self, device: &Device) -> Result<Tensor> {
        let [rows, columns] = self.size;
        let shape = (self.batch(), self.channels, rows, columns);
        if let Some(copied) = self.copied.get()
            && copied.device().same_device(device)
        {
            return Ok(copied.clone());
        }
        let copied = Tensor::from_slice(&self.values, shape, device)?;
        self.copied.get_or_init(|| copied.clone());
        Ok(copied)
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
    fn tensor(&self, device: &Device) -> Result<Tensor> {
        self.frames.tensor(device)?.avg_pool2d(self.by)
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

/// Frames of which some are missing.
pub struct Kept {
    frames: Arc<dyn Frames>,
    /// The factor of each frame: 1, or 0 if it is missing.
    kept: Vec<f32>,
}

impl Kept {
    /// Sets the frames whose factor in `kept` is 0 to 0. The factors of the others are 1.
    pub fn new(frames: Arc<dyn Frames>, kept: Vec<f32>) -> Self {
        Self { frames, kept }
    }
}

impl Frames for Kept {
    fn batch(&self) -> usize {
        self.frames.batch()
    }
    fn channels(&self) -> usize {
        self.frames.channels()
    }
    fn size(&self) -> [usize; 2] {
        self.frames.size()
    }
    fn write(&self, index: usize, frame: &mut [f32]) {
        if self.kept[index] == 0.0 { frame.fill(0.0) } else { self.frames.write(index, frame) }
    }
    fn tensor(&self, device: &Device) -> Result<Tensor> {
        let kept = input(Values::F32(self.kept.clone()), (self.kept.len(), 1, 1, 1), device)?;
        self.frames.tensor(device)?.broadcast_mul(&kept)
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
    fn tensor(&self, device: &Device) -> Result<Tensor> {
        self.frames.tensor(device)?.narrow(0, self.first, self.batch)
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
    fn tensor(&self, device: &Device) -> Result<Tensor> {
        let images = self.0.iter().map(|image| image.tensor(device)).collect::<Result<Vec<_>>>()?;
        Tensor::cat(&images, 1)
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

/// The images of a dataset on a GPU by modality, to which each is copied once; `None` for one that does not fit.
#[derive(Clone, Default)]
pub struct Images(#[cfg(feature = "cuda")] Arc<Mutex<BTreeMap<Modality, Option<crate::cuda::FrameTable>>>>);

/// Normalized frames of chosen samples, computed one at a time.
pub struct SampleFrames {
    samples: Arc<Samples>,
    normalizers: Arc<Normalizers>,
    modality: Modality,
    size: [usize; 2],
    at: Vec<Sample>,
    #[cfg(feature = "cuda")]
    images: Images,
}

impl SampleFrames {
    /// Returns the frames of an image at the samples `at`; `None` for a vector. `images` are those of `samples`, for a
    /// network on a GPU.
    pub fn new(
        samples: &Arc<Samples>,
        normalizers: &Arc<Normalizers>,
        at: &[Sample],
        modality: Modality,
        images: Option<&Images>,
    ) -> Option<Self> {
        let size = samples.layout()[modality].size()?;
        if images.is_none() {
            samples.prefetch(modality, at);
        }
        let (samples, normalizers) = (samples.clone(), normalizers.clone());
        Some(Self {
            samples,
            normalizers,
            modality,
            size,
            at: at.to_vec(),
            #[cfg(feature = "cuda")]
            images: images.cloned().unwrap_or_default(),
        })
    }

    /// Returns the batch by the copy of all images on a GPU; `None` if they do not fit there.
    #[cfg(feature = "cuda")]
    fn gathered(&self, device: &Device) -> Result<Option<Tensor>> {
        let mut images = self.images.0.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let table = match images.entry(self.modality) {
            Entry::Occupied(table) => table.into_mut(),
            Entry::Vacant(place) => {
                let scale = &self.normalizers.modalities[&self.modality];
                place.insert(crate::cuda::FrameTable::new(&self.samples, self.modality, scale, device)?)
            }
        };
        let rows = self.at.iter().map(|sample| sample.index() as u32).collect();
        let frames = table.as_ref().map(|table| crate::cuda::gather(table, rows, device));
        let [height, width] = self.size;
        frames.map(|frames| frames?.reshape((self.at.len(), IMAGE_CHANNELS, height, width))).transpose()
    }
}

impl Frames for SampleFrames {
    fn tensor(&self, device: &Device) -> Result<Tensor> {
        #[cfg(feature = "cuda")]
        if device.is_cuda()
            && let Some(frames) = self.gathered(device)?
        {
            return Ok(frames);
        }
        dense(self, device)
    }

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
