//! Episodes on disk: one Parquet file each, in a folder named after what decides their content.

use super::{DatasetError, Samples};
use crate::files::write_bytes;
use crate::schema::{ARM, frame_column, sample_columns};
use crate::simulation::{Episode, Scene, mujoco_version};
use crate::spec::{ARM_JOINTS, FRAME_LEN, JOINTS, Scenario, Simulation};
use crate::tables::{Stamp, TableError, read_footer, read_table, write_table};
use polars::prelude::*;
use serde_json::json;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};

/// Raised whenever the same spec would be recorded differently than before.
const FORMAT: u32 = 1;
/// Key of an episode's digest in its file's metadata.
const DIGEST: &str = "episode_sha256";

/// One dataset's place on disk.
#[derive(Debug, Clone)]
pub struct Dataset {
    folder: PathBuf,
    name: String,
    scenario: Scenario,
    spec: Simulation,
    description: serde_json::Value,
}

impl Dataset {
    /// The dataset of a scene under a spec, in `root`; nothing is read or written yet.
    pub fn new(root: &Path, scene: &Scene, spec: &Simulation) -> Self {
        let scenario = scene.scenario();
        let description = json!({
            "format": FORMAT,
            "scenario": scenario.name(),
            "simulation": spec,
            "model_sha256": hex(&Sha256::digest(scene.xml())),
            "mujoco": mujoco_version(),
        });
        let mut identity = description.clone();
        // Whether an episode exists does not change what is in it: longer datasets extend shorter ones.
        identity["simulation"]["episodes"].take();
        identity.sort_all_objects();
        let hash = hex(&Sha256::digest(identity.to_string()));
        let name = format!("{}-{}", scenario.name(), &hash[..16]);
        Self { folder: root.join(&name), name, scenario, spec: spec.clone(), description }
    }

    /// The folder's name: the scenario and the hash of what decides the content.
    pub fn name(&self) -> &str {
        &self.name
    }

    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Samples of the whole dataset.
    pub fn len(&self) -> usize {
        self.spec.episodes as usize * self.spec.samples_per_episode()
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    pub fn spec(&self) -> &Simulation {
        &self.spec
    }

    fn episode_path(&self, index: u32) -> PathBuf {
        self.folder.join(format!("episode_{index:05}.parquet"))
    }

    /// Episodes that are not there, or whose file is not what it should be.
    pub fn missing(&self) -> Vec<u32> {
        (0..self.spec.episodes).filter(|index| self.check(*index).is_err()).collect()
    }

    /// Whether an episode's file is there, with a footer that promises what it should.
    fn check(&self, index: u32) -> Result<(), DatasetError> {
        let path = self.episode_path(index);
        let footer = read_footer(&path)?;
        let expected = self.spec.samples_per_episode();
        let damaged = |problem: String| Err(DatasetError::Damaged { path: path.clone(), problem });
        if footer.rows != expected {
            return damaged(format!("it has {} samples instead of {expected}", footer.rows));
        }
        if footer.stamp.get("dataset") != Some(&self.name) {
            return damaged(format!("it does not belong to {}", self.name));
        }
        Ok(())
    }

    /// Writes what the dataset is, for people.
    pub fn describe(&self) -> Result<(), DatasetError> {
        let text = format!("{:#}\n", self.description);
        Ok(write_bytes(&self.folder.join("dataset.json"), text.as_bytes())?)
    }

    /// Writes one episode.
    pub fn save(&self, episode: &Episode) -> Result<(), DatasetError> {
        let stamp = Stamp::from([
            ("dataset".into(), self.name.clone()),
            ("episode".into(), episode.index.to_string()),
            ("simulation_seed".into(), self.spec.seed.to_string()),
            ("mujoco_version".into(), mujoco_version().into()),
            ("harness_version".into(), env!("CARGO_PKG_VERSION").into()),
            ("renderer".into(), episode.renderer.clone()),
            (DIGEST.into(), digest(episode)),
        ]);
        let columns = [sample_columns(), vec![frame_column()]].concat();
        let table = self.table(episode).map_err(TableError::from)?;
        Ok(write_table(&self.episode_path(episode.index), table, &columns, &stamp)?)
    }

    fn table(&self, episode: &Episode) -> PolarsResult<DataFrame> {
        let samples = episode.samples;
        let times = (0..samples).map(|sample| sample as f64 / self.spec.sample_rate_hz);
        let mut columns: Vec<Column> = vec![
            Column::new_scalar("dataset".into(), Scalar::from(PlSmallStr::from_str(&self.name)), samples),
            Column::new_scalar(
                "scenario".into(),
                Scalar::from(PlSmallStr::from_str(self.scenario.name())),
                samples,
            ),
            Column::new_scalar("episode".into(), Scalar::from(episode.index), samples),
            Column::new("sample".into(), (0..samples as u32).collect::<Vec<_>>()),
            Column::new("time".into(), times.collect::<Vec<_>>()),
        ];
        for (name, width, values) in vectors(episode) {
            for index in 0..width {
                let values: Vec<f32> = values.iter().skip(index).step_by(width).copied().collect();
                columns.push(Column::new(element_name(name, width, index).into(), values));
            }
        }
        let frames: BinaryChunked = episode.vision.chunks_exact(FRAME_LEN).map(Some).collect();
        columns.push(frames.with_name("vision".into()).into_series().into());
        DataFrame::new(samples, columns)
    }

    /// Reads the whole dataset into memory, with the frames if asked, and checks every digest it can.
    ///
    /// # Errors
    /// When an episode is missing, or its content is not what was written.
    pub fn load(&self, frames: bool) -> Result<Samples, DatasetError> {
        let mut samples = Samples::with_capacity(self.len(), frames);
        for index in 0..self.spec.episodes {
            self.check(index)?;
            samples.push(&self.read(index, frames)?);
        }
        Ok(samples)
    }

    /// Reads one episode, with or without its frames; with them, its content is compared with its digest.
    pub fn read(&self, index: u32, frames: bool) -> Result<Episode, DatasetError> {
        let path = self.episode_path(index);
        let damaged = |problem: &str| DatasetError::Damaged { path: path.clone(), problem: problem.into() };
        let unreadable = |error: TableError| match error {
            TableError::Read { path, reason } => DatasetError::Damaged { path, problem: reason },
            other => other.into(),
        };
        let footer = read_footer(&path).map_err(unreadable)?;
        let wanted = (!frames).then(|| sample_columns().into_iter().map(|column| column.name).collect());
        let table = read_table(&path, wanted).map_err(unreadable)?;
        let mut episode = Episode { index, samples: table.height(), ..Episode::default() };
        for (name, width, values) in vectors_mut(&mut episode) {
            *values = interleave(&table, name, width).map_err(|_| damaged("a column is missing"))?;
        }
        if frames {
            let vision = table.column("vision").and_then(|column| column.binary().cloned());
            for frame in vision.map_err(|_| damaged("it has no frames"))?.iter() {
                let frame = frame.filter(|frame| frame.len() == FRAME_LEN);
                episode.vision.extend_from_slice(frame.ok_or_else(|| damaged("a frame has the wrong size"))?);
            }
            if footer.stamp.get(DIGEST) != Some(&digest(&episode)) {
                return Err(damaged("its content is not what was written"));
            }
        }
        Ok(episode)
    }

    /// Removes the files of episodes that can't be read as they were written, so that they are made again.
    pub fn discard_damaged(&self, frames: bool) {
        for index in (0..self.spec.episodes).filter(|index| self.read(*index, frames).is_err()) {
            // What can't be removed can't be replaced either, and that is where the reason is reported.
            let _ = std::fs::remove_file(self.episode_path(index));
        }
    }
}

/// Every episode file of every dataset in `root`, as one lazy table without the frames.
pub fn episode_scan(root: &Path) -> PolarsResult<Option<LazyFrame>> {
    let mut paths: Vec<PathBuf> = Vec::new();
    for folder in std::fs::read_dir(root).into_iter().flatten().flatten() {
        for file in std::fs::read_dir(folder.path()).into_iter().flatten().flatten() {
            let name = file.file_name();
            if name.to_string_lossy().starts_with("episode_") {
                paths.push(file.path());
            }
        }
    }
    paths.sort();
    crate::tables::scan(&paths, &sample_columns())
}

/// The vector columns of an episode: name, width and values, in the order of the file.
fn vectors(episode: &Episode) -> [(&'static str, usize, &Vec<f32>); 5] {
    [
        ("proprioception", JOINTS, &episode.proprioception),
        ("arm", ARM_JOINTS, &episode.arm),
        ("setpoint", ARM_JOINTS, &episode.setpoint),
        ("contact_force", JOINTS, &episode.contact_force),
        ("contact_force_mean", JOINTS, &episode.contact_force_mean),
    ]
}

fn vectors_mut(episode: &mut Episode) -> [(&'static str, usize, &mut Vec<f32>); 5] {
    [
        ("proprioception", JOINTS, &mut episode.proprioception),
        ("arm", ARM_JOINTS, &mut episode.arm),
        ("setpoint", ARM_JOINTS, &mut episode.setpoint),
        ("contact_force", JOINTS, &mut episode.contact_force),
        ("contact_force_mean", JOINTS, &mut episode.contact_force_mean),
    ]
}

fn element_name(name: &str, width: usize, index: usize) -> String {
    if width == ARM_JOINTS { format!("{name}_{}", ARM[index].0) } else { format!("{name}_{index:02}") }
}

/// The columns of a vector side by side again, `[samples, width]`.
fn interleave(table: &DataFrame, name: &str, width: usize) -> PolarsResult<Vec<f32>> {
    let mut values = vec![0.0; table.height() * width];
    for index in 0..width {
        let column = table.column(&element_name(name, width, index))?.f32()?;
        for (row, value) in values.chunks_exact_mut(width).zip(column.iter()) {
            row[index] = value.ok_or_else(|| PolarsError::NoData("an empty cell".into()))?;
        }
    }
    Ok(values)
}

/// SHA-256 of everything that an episode recorded.
fn digest(episode: &Episode) -> String {
    let mut hash = Sha256::new();
    for (_, _, values) in vectors(episode) {
        values.iter().for_each(|value| hash.update(value.to_le_bytes()));
    }
    hash.update(&episode.vision);
    hex(&hash.finalize())
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
