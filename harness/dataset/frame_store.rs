//! The frames of a dataset: in memory, or where they would not fit, in a file that the system reads as they are needed.

use harness_shared::memory;
use harness_spec::{IMAGE_CHANNELS, Layout};
use memmap2::{Advice, Mmap, UncheckedAdvice};
use rayon::prelude::*;
use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

/// The share of the memory within reach that frames may take before they go to disk. It is small because training takes
/// memory too, and the system keeps as much of the file in what is free as fits.
const MEMORY_SHARE: u64 = 8;
/// Frames that are laid out by channel at once, on their way to disk.
const FRAMES_AT_ONCE: usize = 256;
/// Frames that are read from disk before their pages are given back, so that they don't count as this process's memory.
/// The system maps 64 KiB around each, half a gigabyte of these at most.
const FRAMES_HELD: usize = 8192;

/// Where a dataset's frames are kept while it is in memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FramePlace {
    /// They aren't loaded.
    Nowhere,
    Memory,
    /// In a temporary file in the dataset's folder.
    Disk,
}

impl FramePlace {
    /// Memory if the frames of so many samples take `limit` bytes at most, by default an eighth of what is within reach.
    pub fn for_samples(layout: &Layout, samples: usize, limit: Option<u64>) -> Self {
        let limit = limit.unwrap_or_else(|| memory::within_reach() / MEMORY_SHARE);
        if frame_bytes(layout, samples) <= limit { Self::Memory } else { Self::Disk }
    }
}

/// What the images of so many samples take, bytes.
pub fn frame_bytes(layout: &Layout, samples: usize) -> u64 {
    let a_sample: usize = layout.stored_images().map(|image| image.width()).sum();
    (samples as u64).saturating_mul(a_sample as u64)
}

/// Frames of one camera one after the other, `[frame, channel, row, column]`.
#[derive(Debug)]
pub(super) struct FrameStore {
    /// Bytes of a frame.
    len: usize,
    kept: Kept,
}

#[derive(Debug)]
enum Kept {
    Memory(Vec<u8>),
    Disk(FrameFile),
}

impl FrameStore {
    /// Room for `samples` frames of `len` bytes; on disk, in `folder`.
    pub fn new(place: FramePlace, len: usize, samples: usize, folder: &Path) -> io::Result<Self> {
        let kept = match place {
            FramePlace::Nowhere => Kept::Memory(Vec::new()),
            FramePlace::Memory => Kept::Memory(Vec::with_capacity(samples * len)),
            FramePlace::Disk => Kept::Disk(FrameFile::new(len, folder)?),
        };
        Ok(Self { len, kept })
    }

    /// Appends frames as cameras and files have them, `[frame, row, column, channel]`.
    pub fn push(&mut self, pixels: &[u8]) -> io::Result<()> {
        let len = self.len;
        match &mut self.kept {
            Kept::Memory(frames) => {
                let before = frames.len();
                frames.resize(before + pixels.len(), 0);
                lay_out(len, pixels, &mut frames[before..]);
            }
            Kept::Disk(file) => {
                let mut planes = vec![0; pixels.len().min(FRAMES_AT_ONCE * len)];
                for pixels in pixels.chunks(FRAMES_AT_ONCE * len) {
                    let planes = &mut planes[..pixels.len()];
                    lay_out(len, pixels, planes);
                    file.append(planes)?;
                }
                file.map_again()?;
            }
        }
        Ok(())
    }

    /// All frames.
    pub fn bytes(&self) -> &[u8] {
        match &self.kept {
            Kept::Memory(frames) => frames,
            Kept::Disk(file) => file.bytes(),
        }
    }

    /// One frame.
    pub fn frame(&self, index: usize) -> &[u8] {
        &self.bytes()[index * self.len..][..self.len]
    }

    /// Says that these frames, and the one before each, are about to be read.
    pub fn prefetch(&self, frames: &[usize]) {
        if let Kept::Disk(file) = &self.kept {
            file.prefetch(frames);
        }
    }
}

/// Lays frames of `len` bytes out channel by channel.
fn lay_out(len: usize, pixels: &[u8], planes: &mut [u8]) {
    let frames = planes.par_chunks_exact_mut(len).zip(pixels.par_chunks_exact(len));
    frames.for_each(|(planes, pixels)| {
        for (channel, plane) in planes.chunks_exact_mut(len / IMAGE_CHANNELS).enumerate() {
            let values = pixels[channel..].iter().step_by(IMAGE_CHANNELS);
            plane.iter_mut().zip(values).for_each(|(value, pixel)| *value = *pixel);
        }
    });
}

/// A file that has no name, so nobody else can open it, and that is gone with the process.
#[derive(Debug)]
struct FrameFile {
    file: File,
    /// Bytes of a frame.
    len: usize,
    /// Of what was written before the last call of [`FrameFile::map_again`]; `None` before the first.
    map: Option<Mmap>,
    /// Frames that were asked for since pages were given back.
    held: AtomicUsize,
}

impl FrameFile {
    fn new(len: usize, folder: &Path) -> io::Result<Self> {
        std::fs::create_dir_all(folder)?;
        Ok(Self { file: tempfile::tempfile_in(folder)?, len, map: None, held: AtomicUsize::new(0) })
    }

    fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.file.write_all(bytes)
    }

    /// Makes all that was written readable.
    fn map_again(&mut self) -> io::Result<()> {
        // SAFETY: the file has no name and its handle is not given away, so only `append` changes it, at its end.
        self.map = Some(unsafe { Mmap::map(&self.file) }?);
        Ok(())
    }

    fn bytes(&self) -> &[u8] {
        self.map.as_deref().unwrap_or_default()
    }

    /// Has the system fetch frames, each with the one before it, side by side; without it each is waited for.
    fn prefetch(&self, frames: &[usize]) {
        let Some(map) = &self.map else { return };
        if self.held.fetch_add(frames.len(), Ordering::Relaxed) > FRAMES_HELD {
            self.held.store(0, Ordering::Relaxed);
            // SAFETY: the pages of a file are read from it again when they are touched again.
            let _ = unsafe { map.unchecked_advise(UncheckedAdvice::DontNeed) };
        }
        for frame in frames {
            let before = frame.saturating_sub(1) * self.len;
            // Advice alone, which may be refused.
            let _ = map.advise_range(Advice::WillNeed, before, (frame + 1) * self.len - before);
        }
    }
}
