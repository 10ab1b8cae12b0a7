//! Recorded courses: setpoints of episodes in a CSV file, one row for each sample.

use super::SimulationError;
use harness_shared::seal::hex;
use harness_spec::{Simulation, World};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Name of the column with the index of the episode.
const EPISODE: &str = "episode";

/// The setpoints of a CSV file.
#[derive(Debug)]
pub(super) struct Course {
    path: PathBuf,
    /// Names of the elements of the action.
    elements: Vec<String>,
    /// The rows of each episode; of all episodes if the file has no column `episode`.
    episodes: Vec<Rows>,
    /// Whether the file has a column `episode`.
    has_episodes: bool,
    /// SHA-256 of the file, in hexadecimal.
    sha256: String,
}

/// The rows of an episode.
#[derive(Debug, Default)]
struct Rows {
    /// `[rows, elements]`.
    setpoints: Vec<f64>,
    /// The line of each row in the file, counted from 1.
    lines: Vec<u64>,
}

impl Course {
    /// Reads the course of a world; `None` if its file names none.
    ///
    /// # Errors
    /// When the file can't be read, lacks a column or an episode, or has a value that is no finite number or out of the
    /// range in the world file.
    pub fn of(world: &World) -> Result<Option<Self>, SimulationError> {
        let Some(path) = world.course() else { return Ok(None) };
        let actuators = || world.file().action.actuators.iter();
        let elements = actuators().map(|(name, _)| name.to_owned()).collect();
        let bytes = std::fs::read(&path).map_err(|error| {
            world.fault("action.course", format!("can't read the course {}: {error}", path.display()))
        })?;
        let course = Self::parse(path, elements, &bytes)?;
        course.check_ranges(&actuators().map(|(_, actuator)| actuator.range).collect::<Vec<_>>())?;
        Ok(Some(course))
    }

    fn parse(path: PathBuf, elements: Vec<String>, bytes: &[u8]) -> Result<Self, SimulationError> {
        let fault = |line: u64, problem: String| course_fault(&path, line, problem);
        let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(bytes);
        let unreadable = |error: csv::Error| fault(error.position().map_or(1, |p| p.line()), said(&error));
        let header = reader.headers().map_err(unreadable)?.clone();
        let place = |name: &str| header.iter().position(|column| column == name);
        let columns: Vec<usize> = elements
            .iter()
            .map(|name| {
                place(name).ok_or_else(|| {
                    let found: Vec<&str> = header.iter().collect();
                    let found = found.join(", ");
                    fault(1, format!("there is no column '{name}', an element of the action; found {found}"))
                })
            })
            .collect::<Result<_, _>>()?;
        let episode = place(EPISODE);
        let mut episodes: BTreeMap<usize, Rows> = BTreeMap::new();
        for record in reader.records() {
            let record = record.map_err(unreadable)?;
            let line = record.position().map_or(1, |position| position.line());
            let index = match episode.map(|column| &record[column]) {
                None => 0,
                Some(text) => text.parse().map_err(|_| {
                    fault(line, format!("{EPISODE}: '{text}' must be the index of an episode, 0 or more"))
                })?,
            };
            let rows = episodes.entry(index).or_default();
            for (name, column) in elements.iter().zip(&columns) {
                let text = &record[*column];
                let value = text.parse().ok().filter(|value: &f64| value.is_finite());
                let value =
                    value.ok_or_else(|| fault(line, format!("{name}: '{text}' must be a finite number")))?;
                rows.setpoints.push(value);
            }
            rows.lines.push(line);
        }
        if episodes.is_empty() {
            return Err(fault(1, "the course has no rows".into()));
        }
        if let Some(missing) = (0..episodes.len()).find(|index| !episodes.contains_key(index)) {
            let problem = format!("there are no rows of episode {missing}; the episodes are counted from 0");
            return Err(fault(1, problem));
        }
        let (has_episodes, episodes) = (episode.is_some(), episodes.into_values().collect());
        Ok(Self { elements, episodes, has_episodes, sha256: hex(&Sha256::digest(bytes)), path })
    }

    /// Returns the SHA-256 of the file, in hexadecimal.
    pub fn sha256(&self) -> &str {
        &self.sha256
    }

    /// Describes the course in a few words.
    pub fn summary(&self) -> String {
        let shortest = self.episodes.iter().map(|rows| rows.lines.len()).min().unwrap_or_default();
        let path = self.path.display();
        match self.has_episodes {
            true => format!("{path}: {} episodes of at least {shortest} samples", self.episodes.len()),
            false => format!("{path}: {shortest} samples, the same in each episode"),
        }
    }

    /// Returns an error unless the course has all samples of a spec's episodes, within these ranges.
    ///
    /// # Errors
    /// Names the line and what is allowed.
    pub fn check(
        &self,
        spec: &Simulation,
        samples: usize,
        ranges: &[[f64; 2]],
    ) -> Result<(), SimulationError> {
        let count = self.episodes.len();
        if self.has_episodes && (spec.episodes as usize) > count {
            let problem = format!(
                "the course has {count} episodes, and simulation.episodes is {}; set it to {count} or fewer",
                spec.episodes
            );
            return Err(course_fault(&self.path, 1, problem));
        }
        for rows in self.episodes.iter().take(spec.episodes as usize) {
            if rows.lines.len() < samples {
                let (last, count) = (rows.lines.last().copied().unwrap_or(1), rows.lines.len());
                let problem = format!(
                    "the episode ends after {count} rows, and its {samples} samples need a row each; add rows, or \
                     lower simulation.actuations_per_episode"
                );
                return Err(course_fault(&self.path, last, problem));
            }
        }
        self.check_ranges(ranges)
    }

    /// Returns an error unless all setpoints are within these ranges.
    fn check_ranges(&self, ranges: &[[f64; 2]]) -> Result<(), SimulationError> {
        for rows in &self.episodes {
            for (line, setpoint) in rows.lines.iter().zip(rows.setpoints.chunks(ranges.len())) {
                for (name, (value, [low, high])) in self.elements.iter().zip(setpoint.iter().zip(ranges)) {
                    if !(*low..=*high).contains(value) {
                        let problem = format!("{name}: {value} is outside of its range [{low}, {high}]");
                        return Err(course_fault(&self.path, *line, problem));
                    }
                }
            }
        }
        Ok(())
    }

    /// Returns the setpoints of an episode, `[rows, elements]`. After the last episode, the first one follows.
    pub fn episode(&self, index: u32) -> &[f64] {
        &self.episodes[index as usize % self.episodes.len()].setpoints
    }
}

fn course_fault(path: &Path, line: u64, problem: String) -> SimulationError {
    SimulationError::Other(format!("{}:{line}: {problem}", path.display()))
}

/// The message of an error of the CSV reader, without the place.
fn said(error: &csv::Error) -> String {
    match error.kind() {
        csv::ErrorKind::UnequalLengths { expected_len, len, .. } => {
            format!("the row has {len} values, and the first line has {expected_len} names")
        }
        csv::ErrorKind::Utf8 { .. } => "the file is not UTF-8 text".into(),
        _ => error.to_string(),
    }
}
