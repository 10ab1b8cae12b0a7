//! The file of an episode.

use super::DatasetError;
use harness_samples::Samples;
use harness_shared::progress::Progress;
use harness_spec::{Definition, Episode, Layout};
use harness_tables::{TableError, TableFile};
use polars::prelude::*;
use rayon::prelude::*;
use std::path::Path;
use std::sync::Arc;

/// Returns the name of an episode's file.
pub(super) fn episode_file(index: u32) -> String {
    format!("episode_{index:05}.parquet")
}

/// Appends episodes in order. As many episodes as there are threads are read at the same time, so only these are in
/// memory.
pub(super) fn push_all(
    samples: &mut Samples,
    episodes: u32,
    read: impl Fn(u32) -> Result<Episode, DatasetError> + Sync,
    progress: &dyn Progress,
) -> Result<(), DatasetError> {
    let at_once = rayon::current_num_threads();
    for first in (0..episodes).step_by(at_once) {
        if progress.cancelled() {
            return Err(DatasetError::Cancelled);
        }
        let indices = first..episodes.min(first + at_once as u32);
        let read: Vec<_> = indices.into_par_iter().map(&read).collect();
        for episode in read {
            let episode = episode?;
            samples.push(&episode)?;
            progress.advance(episode.samples as u64);
        }
    }
    Ok(())
}

/// Reads the file of episode `index` of the dataset `dataset`. It must have `samples` samples of this layout.
pub(super) fn read_episode(
    path: &Path,
    dataset: &str,
    index: u32,
    samples: usize,
    frames: bool,
    layout: &Arc<Layout>,
) -> Result<Episode, DatasetError> {
    let damaged = |problem: &str| DatasetError::Damaged { path: path.to_owned(), problem: problem.into() };
    let mut wanted: Vec<String> = layout.stored_vectors().flat_map(Definition::columns).collect();
    if frames {
        wanted.extend(layout.stored_images().map(|image| image.name.name().to_owned()));
    }
    let table = open_episode(path, dataset, index, samples)?.table(Some(wanted))?;
    let mut episode = Episode::new(layout.clone(), index, samples);
    for (place, definition) in layout.modalities.iter().enumerate() {
        if definition.difference_of.is_some() {
            continue;
        }
        if !definition.is_image() {
            let values = interleave(&table, definition).map_err(|_| damaged("a column is missing"))?;
            episode.vectors[place] = values;
        } else if frames {
            let column = table.column(definition.name.name()).and_then(|column| column.binary().cloned());
            for frame in column.map_err(|_| damaged("it has no frames"))?.iter() {
                let frame = frame.filter(|frame| frame.len() == definition.width());
                let frame = frame.ok_or_else(|| damaged("a frame has the wrong size"))?;
                episode.images[place].extend_from_slice(frame);
            }
        }
    }
    Ok(episode)
}

/// Opens the file of episode `index` of the dataset `dataset`. It must have `samples` samples.
pub(super) fn open_episode(
    path: &Path,
    dataset: &str,
    index: u32,
    samples: usize,
) -> Result<TableFile, DatasetError> {
    let damaged = |problem: String| DatasetError::Damaged { path: path.to_owned(), problem };
    let file = TableFile::open(path).map_err(|error| match error {
        TableError::Read { path, reason } => DatasetError::Damaged { path, problem: reason },
        other => other.into(),
    })?;
    let footer = file.footer()?;
    let says = |key: &str, value: &str| footer.stamp.get(key).is_some_and(|found| found == value);
    if !says("dataset", dataset) || !says("episode", &index.to_string()) {
        return Err(damaged(format!("it is not episode {index} of {dataset}")));
    }
    if footer.rows != samples {
        return Err(damaged(format!("it has {} samples instead of {samples}", footer.rows)));
    }
    Ok(file)
}

/// Joins the columns of a vector, `[samples, elements]`.
fn interleave(table: &DataFrame, definition: &Definition) -> PolarsResult<Vec<f32>> {
    let width = definition.width();
    let mut values = vec![0.0; table.height() * width];
    for (index, name) in definition.columns().enumerate() {
        let column = table.column(&name)?.f32()?;
        for (row, value) in values.chunks_exact_mut(width).zip(column.iter()) {
            row[index] = value.ok_or_else(|| PolarsError::NoData("an empty cell".into()))?;
        }
    }
    Ok(values)
}
