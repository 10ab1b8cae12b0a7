//! The runs that a user names: by the beginning of a name, or by the path of a folder.

use super::folders::Recorded;
use super::{Registry, RegistryError, RunFolder, RunRecord};
use harness_shared::files::{real, within};
use harness_shared::numbers::first_few;
use harness_shared::{nearest, quoted};
use std::path::Path;

/// The maximum number of runs that a message lists. The others are only counted.
const NAMES_SHOWN: usize = 5;

impl Registry {
    /// The only run whose id, or `experiment/id`, begins with `wanted`. The path of a run's folder is allowed, too.
    ///
    /// # Errors
    /// When no run matches, or several do.
    pub fn find(&self, wanted: &str) -> Result<(RunFolder, RunRecord), RegistryError> {
        let wanted = &*self.name_of(wanted);
        let mut matches = self.records();
        matches.retain(|record| record.run.starts_with(wanted) || record.name().starts_with(wanted));
        match matches.as_slice() {
            [record] => Ok((self.folder_of(record), record.clone())),
            [] => Err(self.unknown(wanted)),
            several => {
                let names: Vec<String> = several.iter().map(RunRecord::name).collect();
                let names = first_few(&names, NAMES_SHOWN);
                Err(RegistryError::Unknown(format!(
                    "'{wanted}' matches several runs: {names}; name one of them"
                )))
            }
        }
    }

    /// Returns the runs of the experiment `wanted`. If there is no such experiment, returns the runs whose id, or
    /// `experiment/id` if `wanted` has a slash, begins with it. The path of a folder of runs is allowed, too.
    pub fn matching(&self, wanted: &str) -> Result<Vec<Recorded>, RegistryError> {
        let wanted = &*self.name_of(wanted);
        let mut recorded = self.recorded();
        let is_experiment = recorded.iter().any(|(_, record)| record.experiment == wanted);
        let is_match = |record: &RunRecord| match is_experiment {
            true => record.experiment == wanted,
            false if wanted.contains('/') => record.name().starts_with(wanted),
            false => !wanted.is_empty() && record.run.starts_with(wanted),
        };
        recorded.retain(|(_, record)| is_match(record));
        if recorded.is_empty() {
            return Err(self.unknown(wanted));
        }
        Ok(recorded)
    }

    /// Whether a folder is this results folder, or in one of its folders.
    pub fn contains(&self, folder: &Path) -> bool {
        let own = ["runs", "datasets", "compacted", "specs", "jobs"];
        let is_in = |part: &str| within(&self.root.join(part), folder).is_some();
        real(folder) == real(&self.root) || own.into_iter().any(is_in)
    }

    /// The name of a run or an experiment, without the path of the folder of all runs and without the slash that a
    /// shell adds to a folder.
    fn name_of(&self, wanted: &str) -> String {
        let wanted = wanted.strip_suffix('/').filter(|name| name.contains('/')).unwrap_or(wanted);
        let name = within(&self.runs(), Path::new(wanted));
        let name = name.as_deref().and_then(Path::to_str).filter(|name| !name.is_empty());
        name.unwrap_or(wanted).to_owned()
    }

    /// The error that no run matches `wanted`. It names the nearest run, or those of the experiment in `wanted`.
    fn unknown(&self, wanted: &str) -> RegistryError {
        let records = self.records();
        let names = records.iter().flat_map(|record| [record.run.clone(), record.name()]);
        let nearest = beginning_nearest(wanted, &names.collect::<Vec<_>>());
        let experiment = wanted.split_once('/').map(|(experiment, _)| experiment);
        let own = records.iter().filter(|record| Some(&*record.experiment) == experiment);
        let there: Vec<String> = own.map(|record| record.run.clone()).collect();
        let list = match experiment.filter(|_| !there.is_empty()) {
            Some(experiment) => self.command(&format!("ls {}", quoted([experiment]))),
            None => self.command("ls"),
        };
        let instead = match (nearest, there.as_slice()) {
            (Some(nearest), _) => format!(", the nearest is '{nearest}'"),
            (None, []) => String::new(),
            (None, there) => format!("; the runs of this experiment are {}", first_few(there, NAMES_SHOWN)),
        };
        RegistryError::Unknown(format!("no run matches '{wanted}'{instead}; `{list}` lists them"))
    }
}

/// The first of `names` whose beginning is the nearest to `wanted`, if one is near enough.
fn beginning_nearest(wanted: &str, names: &[String]) -> Option<String> {
    if wanted.is_empty() {
        return None;
    }
    let beginning = |name: &String| name.chars().take(wanted.chars().count()).collect::<String>();
    let beginnings: Vec<String> = names.iter().map(beginning).collect();
    let nearest = nearest(wanted, &beginnings.iter().map(String::as_str).collect::<Vec<_>>())?;
    names.iter().find(|name| name.starts_with(nearest)).cloned()
}
