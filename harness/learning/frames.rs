//! Batches of frames that are computed one frame at a time, when they are needed.
//!
//! A batch of 1024 normalized frames takes 50 MB. An op that asks for one frame at a time keeps it in the processor's
//! cache, and no batch has to be assembled before.

use candle_core::{Device, Result, Tensor};
use std::sync::Arc;

/// A batch of normalized frames, `[channels, side, side]` each.
pub trait Frames: Send + Sync {
    /// Returns the number of frames in the batch.
    fn batch(&self) -> usize;
    /// Returns the number of channels of a frame.
    fn channels(&self) -> usize;
    /// Returns the side of a frame in pixels.
    fn side(&self) -> usize;
    /// Writes frame `index`, `[channels, side, side]`, to `frame`.
    fn write(&self, index: usize, frame: &mut [f32]);

    /// Returns the number of values of a frame.
    fn frame_len(&self) -> usize {
        self.channels() * self.side() * self.side()
    }

    /// Returns the whole batch as a tensor `[batch, channels, side, side]`.
    fn tensor(&self, device: &Device) -> Result<Tensor> {
        let mut values = vec![0.0; self.batch() * self.frame_len()];
        for (index, frame) in values.chunks_exact_mut(self.frame_len()).enumerate() {
            self.write(index, frame);
        }
        Tensor::from_vec(values, (self.batch(), self.channels(), self.side(), self.side()), device)
    }
}

/// Frames that are in memory as `f32`, `[batch, channels, side, side]`.
pub struct DenseFrames {
    values: Vec<f32>,
    channels: usize,
    side: usize,
}

impl DenseFrames {
    /// Copies the values of a tensor `[batch, channels, side, side]`.
    pub fn new(frames: &Tensor) -> Result<Self> {
        let (_, channels, side, _) = frames.dims4()?;
        Ok(Self { values: frames.flatten_all()?.to_vec1()?, channels, side })
    }
}

impl Frames for DenseFrames {
    fn batch(&self) -> usize {
        self.values.len() / self.frame_len()
    }
    fn channels(&self) -> usize {
        self.channels
    }
    fn side(&self) -> usize {
        self.side
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
    /// Averages `frames` over squares with a side of `by` pixels, which must divide the frames' side. Returns `frames`
    /// if `by` is 1.
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
    fn side(&self) -> usize {
        self.frames.side() / self.by
    }
    fn write(&self, index: usize, frame: &mut [f32]) {
        let mut whole = vec![0.0; self.frames.frame_len()];
        self.frames.write(index, &mut whole);
        let (fine_side, side) = (self.frames.side(), self.side());
        frame.fill(0.0);
        for (row, values) in whole.chunks_exact(fine_side).enumerate() {
            let (channel, row) = (row / fine_side, row % fine_side / self.by);
            let averaged = &mut frame[(channel * side + row) * side..][..side];
            for (average, square) in averaged.iter_mut().zip(values.chunks_exact(self.by)) {
                *average += square.iter().sum::<f32>();
            }
        }
        let factor = 1.0 / (self.by * self.by) as f32;
        frame.iter_mut().for_each(|value| *value *= factor);
    }
}
