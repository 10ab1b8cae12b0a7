//! The frames of a dataset. They are in memory or, if they do not fit there, in a file that the system reads when
//! needed.

use super::Sample;
use harness_shared::memory;
use harness_spec::{IMAGE_CHANNELS, Layout};
use memmap2::{Advice, Mmap, UncheckedAdvice};
use rayon::prelude::*;
use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Frames that take more than the available memory divided by this number are stored on disk. The limit is low because
/// training takes memory too, and because the system caches as much of the file as fits in free memory.
const MEMORY_SHARE: u64 = 8;
/// Number of frames that are converted to channel order at once before they are written to disk.
pub(super) const FRAMES_AT_ONCE: usize = 256;
/// Number of frames that are read from disk before their pages are released, so that they don't count as this process's
/// memory. The system maps 64 KiB around each frame, which is at most half a gigabyte for this number.
const FRAMES_HELD: usize = 8192;

/// Where the frames of a loaded dataset are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FramePlace {
    /// The frames aren't loaded.
    Nowhere,
    /// In memory.
    Memory,
    /// In a temporary file in the dataset's folder.
    Disk,
}

impl FramePlace {
    /// Returns `Memory` if the frames of this number of samples take at most `limit` bytes, and else `Disk`. The
    /// default limit is an eighth of the available memory.
    pub fn for_samples(layout: &Layout, samples: usize, limit: Option<u64>) -> Self {
        let limit = limit.unwrap_or_else(|| memory::within_reach() / MEMORY_SHARE);
        if frame_bytes(layout, samples) <= limit { Self::Memory } else { Self::Disk }
    }
}

/// Returns the number of bytes that the images of this number of samples take.
pub fn frame_bytes(layout: &Layout, samples: usize) -> u64 {
    let a_sample: usize = layout.stored_images().map(|image| image.width()).sum();
    (samples as u64).saturating_mul(a_sample as u64)
}

/// The frames of one camera, one after the other, `[frame, channel, row, column]`.
#[derive(Debug)]
pub(super) struct FrameStore {
    /// Number of bytes of a frame.
    len: usize,
    kept: Kept,
}

#[derive(Debug)]
enum Kept {
    Memory(Vec<u8>),
    Disk(FrameFile),
}

impl FrameStore {
    /// Creates a store for `samples` frames of `len` bytes. On disk, its file is created in `folder`.
    pub fn new(place: FramePlace, len: usize, samples: usize, folder: &Path) -> io::Result<Self> {
        let kept = match place {
            FramePlace::Nowhere => Kept::Memory(Vec::new()),
            FramePlace::Memory => Kept::Memory(Vec::with_capacity(samples * len)),
            FramePlace::Disk => Kept::Disk(FrameFile::new(len, folder)?),
        };
        Ok(Self { len, kept })
    }

    /// Returns an empty store for `samples` frames of the same size, in the same place.
    pub fn empty(&self, samples: usize, folder: &Path) -> io::Result<Self> {
        let place = match &self.kept {
            Kept::Memory(_) => FramePlace::Memory,
            Kept::Disk(_) => FramePlace::Disk,
        };
        Self::new(place, self.len, samples, folder)
    }

    /// Appends frames in the order of this store, `[frame, channel, row, column]`. They are readable after
    /// [`finish`](Self::finish).
    pub fn append(&mut self, planes: &[u8]) -> io::Result<()> {
        match &mut self.kept {
            Kept::Memory(frames) => {
                frames.extend_from_slice(planes);
                Ok(())
            }
            Kept::Disk(file) => file.append(planes),
        }
    }

    /// Makes all appended frames readable.
    pub fn finish(&mut self) -> io::Result<()> {
        match &mut self.kept {
            Kept::Memory(_) => Ok(()),
            Kept::Disk(file) => file.map_again(),
        }
    }

    /// Appends frames in the order of cameras and files, `[frame, row, column, channel]`.
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

    /// Returns all frames.
    pub fn bytes(&self) -> &[u8] {
        match &self.kept {
            Kept::Memory(frames) => frames,
            Kept::Disk(file) => file.bytes(),
        }
    }

    /// Returns one frame.
    pub fn frame(&self, index: usize) -> &[u8] {
        &self.bytes()[index * self.len..][..self.len]
    }

    /// Announces that these frames, and the one before each of them, are about to be read.
    pub fn prefetch(&self, frames: &[Sample]) {
        if let Kept::Disk(file) = &self.kept {
            file.prefetch(frames);
        }
    }
}

/// Converts frames of `len` bytes from pixel order to channel order.
fn lay_out(len: usize, pixels: &[u8], planes: &mut [u8]) {
    let frames = planes.par_chunks_exact_mut(len).zip(pixels.par_chunks_exact(len));
    frames.for_each(|(planes, pixels)| {
        for (channel, plane) in planes.chunks_exact_mut(len / IMAGE_CHANNELS).enumerate() {
            let values = pixels[channel..].iter().step_by(IMAGE_CHANNELS);
            plane.iter_mut().zip(values).for_each(|(value, pixel)| *value = *pixel);
        }
    });
}

/// A file without a name. No other process can open it, and it is deleted when this process ends.
#[derive(Debug)]
struct FrameFile {
    file: File,
    /// Number of bytes of a frame.
    len: usize,
    /// The contents at the last call of [`FrameFile::map_again`]; `None` before the first call.
    map: Option<Mmap>,
    /// Number of frames that were prefetched since pages were last released.
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

    /// Makes all written frames readable.
    fn map_again(&mut self) -> io::Result<()> {
        // SAFETY: the file has no name and its handle stays in this struct. So only `append` changes it, at its end.
        self.map = Some(unsafe { Mmap::map(&self.file) }?);
        Ok(())
    }

    fn bytes(&self) -> &[u8] {
        self.map.as_deref().unwrap_or_default()
    }

    /// Asks the system to read several frames at once, each with the frame before it. Otherwise the reader would wait
    /// for each frame.
    fn prefetch(&self, frames: &[Sample]) {
        let Some(map) = &self.map else { return };
        if self.held.fetch_add(frames.len(), Ordering::Relaxed) > FRAMES_HELD {
            self.held.store(0, Ordering::Relaxed);
            // SAFETY: released pages of a file are read again from the file when they are accessed.
            let _ = unsafe { map.unchecked_advise(UncheckedAdvice::DontNeed) };
        }
        for frame in frames.iter().map(|frame| frame.index()) {
            let before = frame.saturating_sub(1) * self.len;
            // The system may refuse this advice, which does no harm.
            let _ = map.advise_range(Advice::WillNeed, before, (frame + 1) * self.len - before);
        }
    }
}
