//! Which version of each world counts. Results of a world before and after a change are never averaged.

use super::record::SimulatedFor;
use super::{Recorded, Registry, RunRecord, Status, WorldOf};
use crate::dataset::WorldVersion;
use harness_shared::numbers::counted;
use harness_spec::Simulation;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

/// The name of a version of a world that is not known, because the run's record does not say it.
pub const UNKNOWN: &str = "unknown";

/// Returns the names of the datasets that these settings give in a world as its file or the program has it now. `None`
/// if the world can't be read or compiled.
pub type DatasetsNow = fn(&WorldOf, &[&Simulation]) -> Option<Vec<String>>;

/// The finished runs of a results folder that don't count, because their world has changed since.
#[derive(Debug, Clone, Default)]
pub struct Outdated {
    /// For each dataset of such runs: the version of the world, and the one that counts.
    datasets: BTreeMap<String, [WorldVersion; 2]>,
}

/// Runs on a dataset.
struct OnDataset<'a> {
    /// The one that was started last.
    latest: &'a RunRecord,
    /// The dataset.
    of: SimulatedFor<'a>,
    version: WorldVersion,
}

impl Registry {
    /// The same folder, from which nothing has been left out so far.
    pub fn anew(&self) -> Self {
        Self { left_out: Default::default(), ..self.clone() }
    }

    /// The folder, with a function that says what worlds are like now. Without it, the versions of worlds that the
    /// latest runs have are those that count.
    pub fn with_worlds(self, datasets_now: DatasetsNow) -> Self {
        Self { datasets_now: Some(datasets_now), ..self }
    }

    /// The finished runs that don't count, because their world has changed since. `recorded` are all runs of the
    /// folder.
    ///
    /// Of each world, one version counts in all experiments: that of its file or, if no finished run has it, that of
    /// the run that was started last. Worlds are told apart by their names. Only if several files of the same name
    /// exist, each is a world of its own.
    pub fn outdated(&self, recorded: &[Recorded]) -> Outdated {
        let mut outdated = Outdated::default();
        for (world, mut datasets) in worlds(recorded) {
            datasets.sort_by_key(|on| Reverse((&on.latest.started, &on.latest.run)));
            let of_latest = agreeing(&datasets);
            // Only then is it worth compiling the world.
            if of_latest.iter().all(|agrees| *agrees) {
                continue;
            }
            let of_file = world.and_then(|world| self.made_now(&world, &datasets));
            let counts = of_file.filter(|made_now| made_now.contains(&true)).unwrap_or(of_latest);
            let Some(counted) = counts.iter().position(|counts| *counts) else { continue };
            let others = datasets.iter().zip(&counts).filter(|(_, counts)| !**counts);
            let versions = |on: &OnDataset| [on.version.clone(), datasets[counted].version.clone()];
            outdated.datasets.extend(others.map(|(on, _)| (on.of.dataset.to_owned(), versions(on))));
        }
        outdated
    }

    /// Whether the same runs would be made on each of these datasets now. `None` if the world can't be compiled.
    fn made_now(&self, world: &WorldOf, datasets: &[OnDataset]) -> Option<Vec<bool>> {
        let settings: Vec<&Simulation> = datasets.iter().map(|on| &on.of.simulation).collect();
        let now = self.datasets_now?(world, &settings)?;
        Some(datasets.iter().zip(&now).map(|(on, now)| on.of.dataset == now).collect())
    }

    /// Remembers that these runs are left out, for the message about what was left out.
    pub fn leave_out_outdated<'a>(
        &self,
        outdated: &Outdated,
        records: impl IntoIterator<Item = &'a RunRecord>,
    ) {
        self.note_outdated(outdated, records, |note, remove| {
            format!("left out: {note}; `{remove}` removes them, and --where world=VERSION selects a version")
        });
    }

    /// Remembers that a query also sees these runs, for the message about what was left out.
    pub fn mention_outdated<'a>(
        &self,
        outdated: &Outdated,
        records: impl IntoIterator<Item = &'a RunRecord>,
    ) {
        self.note_outdated(outdated, records, |note, remove| {
            let distinguish = "the column world_version of the table runs tells them apart";
            format!("the query also sees {note}; {distinguish}, and `{remove}` removes them")
        });
    }

    /// Remembers a message for each world of these runs. `message` makes it of what the runs are and of the command that
    /// removes them.
    fn note_outdated<'a>(
        &self,
        outdated: &Outdated,
        records: impl IntoIterator<Item = &'a RunRecord>,
        message: impl Fn(&str, &str) -> String,
    ) {
        let remove = self.command("gc --only world");
        for (scenario, note) in outdated.notes(records) {
            self.leave_out(&self.root.join("worlds").join(scenario), message(&note, &remove));
        }
    }
}

impl Outdated {
    /// Whether a run does not count.
    pub fn has(&self, record: &RunRecord) -> bool {
        let test = record.test_dataset.as_ref().filter(|_| record.spec.other_world().is_some());
        let mut datasets = std::iter::once(&record.dataset).chain(test);
        record.status == Status::Done && datasets.any(|dataset| self.datasets.contains_key(dataset))
    }

    /// A sentence about those of these runs that don't count, for each world, with the world's name.
    fn notes<'a>(&self, records: impl IntoIterator<Item = &'a RunRecord>) -> Vec<(&'a str, String)> {
        // The number of runs of each version, and the parts that differ.
        type Versions<'a> = BTreeMap<String, (usize, BTreeSet<&'a str>)>;
        let mut worlds: BTreeMap<&str, Versions> = BTreeMap::new();
        for record in records.into_iter().filter(|record| self.has(record)) {
            for SimulatedFor { dataset, scenario, version, .. } in record.simulated() {
                let Some([own, counts]) = self.datasets.get(dataset) else { continue };
                let versions = worlds.entry(scenario.name()).or_default();
                let (runs, parts) = versions.entry(id_of(version)).or_default();
                *runs += 1;
                if version.is_some() {
                    parts.extend(own.differing(counts));
                }
            }
        }
        let note = |(scenario, versions): (&'a str, Versions)| {
            let runs: usize = versions.values().map(|(runs, _)| runs).sum();
            let versions = versions.into_iter().map(|(id, (_, parts))| {
                let parts = parts.into_iter().collect::<Vec<_>>().join(", ");
                if parts.is_empty() { id } else { format!("{id}, which differs in {parts}") }
            });
            let versions = versions.collect::<Vec<_>>().join("; ");
            let runs = counted(runs, "finished run");
            let note = format!("{runs} in other versions of the world {scenario}: {versions}");
            (scenario, note)
        };
        worlds.into_iter().map(note).collect()
    }
}

impl RunRecord {
    /// A short name of the version of the run's world, or [`UNKNOWN`].
    pub fn world_version(&self) -> String {
        id_of(self.provenance.world.as_ref())
    }
}

/// A short name of a version of a world, or [`UNKNOWN`].
fn id_of(version: Option<&WorldVersion>) -> String {
    version.map_or_else(|| UNKNOWN.to_owned(), WorldVersion::id)
}

/// Whether the version of each dataset agrees with those before it that agree with the first one.
fn agreeing(datasets: &[OnDataset]) -> Vec<bool> {
    let mut counts: Option<WorldVersion> = None;
    let agrees = |on: &OnDataset| {
        let counts = counts.get_or_insert_with(|| on.version.clone());
        let agrees = counts.agrees_with(&on.version);
        if agrees {
            counts.extend(&on.version);
        }
        agrees
    };
    datasets.iter().map(agrees).collect()
}

/// The simulated datasets of finished runs by world. A world is `None` if its file is not known or gone.
fn worlds(recorded: &[Recorded]) -> Vec<(Option<WorldOf>, Vec<OnDataset<'_>>)> {
    let mut latest: BTreeMap<&str, (&RunRecord, SimulatedFor)> = BTreeMap::new();
    let records = recorded.iter().map(|(_, record)| record);
    for record in records.filter(|record| record.status == Status::Done) {
        for of in record.simulated() {
            let other = latest.entry(of.dataset).or_insert_with(|| (record, of.clone()));
            if (&record.started, &record.run) > (&other.0.started, &other.0.run) {
                *other = (record, of);
            }
        }
    }
    let mut worlds: BTreeMap<&str, BTreeMap<Option<WorldOf>, Vec<OnDataset>>> = BTreeMap::new();
    for (latest, of) in latest.into_values() {
        let world = Some(of.world.clone()).filter(|world| match world {
            WorldOf::BuiltIn(_) => true,
            WorldOf::File(path) => path.exists(),
            WorldOf::Dataset(_) => false,
        });
        let version = of.version.cloned().unwrap_or_else(|| unknown(&of));
        let same_name = worlds.entry(of.scenario.name()).or_default();
        same_name.entry(world).or_default().push(OnDataset { latest, of, version });
    }
    let mut all = Vec::new();
    for mut same_name in worlds.into_values() {
        // A folder may have been moved or copied: a file that is gone is the only one of its name that there is.
        if same_name.len() == 2
            && let Some(gone) = same_name.remove(&None)
            && let Some(there) = same_name.values_mut().next()
        {
            there.extend(gone);
        }
        all.extend(same_name);
    }
    all
}

/// The version of a world of which only the dataset is known. Each dataset with the same settings is another one.
fn unknown(of: &SimulatedFor) -> WorldVersion {
    let settings = Simulation { episodes: 0, ..of.simulation.clone() };
    let settings = serde_json::to_string(&settings).unwrap_or_default();
    WorldVersion::unknown(&settings, of.dataset)
}
