//! Describes the runs of a results folder in words: how they ended and where their numbers come from.

use super::Asked;
use harness_registry::{Registry, RunRecord, Status, Timings};
use harness_shared::numbers::duration;
use serde::Serialize;
use std::collections::BTreeMap;

/// An experiment's runs.
#[derive(Serialize)]
pub struct Experiment {
    name: String,
    /// The question of the experiment: that of the spec of its first run or, in records of earlier versions, of the
    /// built-in experiment of this name.
    description: Option<String>,
    /// The number of runs that are done.
    pub done: usize,
    /// All runs, sorted by scenario, settings that vary, latent size and seed.
    runs: Vec<Run>,
}

/// A run's record in words.
#[derive(Serialize)]
struct Run {
    cell: String,
    status: &'static str,
    seed: u64,
    /// Wall time of all stages together. Empty if the run isn't done.
    took: String,
    /// The spec's hash.
    spec: String,
    /// The commit's first eight digits, with a plus if the source tree had uncommitted changes.
    commit: String,
    host: String,
    /// All values of the record, each with its name.
    details: Vec<(&'static str, String)>,
}

/// Returns the runs that are asked for, grouped by experiment.
pub fn experiments(registry: &Registry, asked: &Asked) -> Vec<Experiment> {
    let mut experiments: BTreeMap<String, Vec<RunRecord>> = BTreeMap::new();
    for record in registry.records().into_iter().filter(|record| asked.has_run(record)) {
        experiments.entry(record.experiment.clone()).or_default().push(record);
    }
    experiments.into_iter().map(|(name, records)| Experiment::new(name, records)).collect()
}

impl Experiment {
    fn new(name: String, mut records: Vec<RunRecord>) -> Self {
        records.sort_by_cached_key(|record| {
            let spec = &record.spec;
            (
                spec.scenario.clone(),
                spec.variant.clone(),
                spec.latent(),
                spec.seed,
                record.started.clone(),
                record.run.clone(),
            )
        });
        let done = records.iter().filter(|record| record.status == Status::Done).count();
        let own = records.iter().map(|record| &record.provenance.description).find(|text| !text.is_empty());
        let description = own.cloned().or_else(|| harness_spec::description(&name));
        Self { name, description, done, runs: records.iter().map(Run::new).collect() }
    }
}

impl Run {
    fn new(record: &RunRecord) -> Self {
        let by = &record.provenance;
        let commit: String = by.git_commit.iter().flat_map(|commit| commit.chars()).take(8).collect();
        let dirty = if by.git_dirty == Some(true) { "+" } else { "" };
        Self {
            cell: record.spec.cell(),
            status: record.status.name(),
            seed: record.spec.seed,
            took: record.timings.map(|timings| duration(total(&timings))).unwrap_or_default(),
            spec: record.spec_hash.clone(),
            commit: format!("{commit}{dirty}"),
            host: by.host.clone(),
            details: details(record),
        }
    }
}

/// Wall time of all stages together, s.
fn total(timings: &Timings) -> f64 {
    timings.collect + timings.prediction + timings.reconstruction.unwrap_or_default() + timings.evaluation
}

/// Names and values of everything that a record contains about a run, in words.
fn details(record: &RunRecord) -> Vec<(&'static str, String)> {
    let by = &record.provenance;
    let commit = by.git_commit.as_ref().map(|commit| {
        let changed = if by.git_dirty == Some(true) { ", with uncommitted changes" } else { "" };
        format!("{commit}{changed}")
    });
    let stages = record.timings.map(|timings| {
        let reconstruction = timings
            .reconstruction
            .map(|time| format!(", reconstruction {}", duration(time)))
            .unwrap_or_default();
        format!(
            "dataset {}, prediction {}{reconstruction}, evaluation {}",
            duration(timings.collect),
            duration(timings.prediction),
            duration(timings.evaluation)
        )
    });
    let memory = record.peak_memory_bytes.map(|bytes| format!("{:.0} MB at most", bytes as f64 / 1e6));
    let details = [
        ("run", Some(record.run.clone())),
        ("failed", record.reason.clone()),
        ("dataset", Some(record.dataset.clone())),
        ("test dataset", record.test_dataset.clone()),
        ("commit", commit),
        ("started", Some(record.started.clone())),
        ("time", stages),
        ("memory", memory),
        ("parameters", record.parameters.map(|count| count.to_string())),
        ("machine", Some(format!("{}, {}, {} threads", by.host, by.processor, by.threads))),
        (
            "versions",
            Some(format!(
                "harness {}, MuJoCo {}, candle {}",
                by.harness_version, by.mujoco_version, by.candle_version
            )),
        ),
        ("command", Some(by.command.clone())),
    ];
    details.into_iter().filter_map(|(name, value)| Some((name, value?))).collect()
}
