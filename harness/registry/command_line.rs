//! Command lines of the harness, as text.

use super::{DEFAULT_ROOT, Registry};
use harness_shared::{path_word, quoted};
use harness_spec::RunSpec;
use std::path::Path;

impl Registry {
    /// A command line of the harness for this results folder: `harness --results FOLDER` followed by `command`.
    pub fn command(&self, command: &str) -> String {
        command_in(&self.root, command)
    }
}

/// A command line of the harness for the results folder `root`. The default folder needs no `--results`.
pub(super) fn command_in(root: &Path, command: &str) -> String {
    if root == Path::new(DEFAULT_ROOT) {
        return format!("harness {command}");
    }
    format!("harness --results {} {command}", path_word(root))
}

/// The command that makes only the run of `spec`, one of the runs that `command` makes. Lists of seeds, latent sizes,
/// scenarios and varied settings are reduced to the run's own values. Otherwise the records of a thousand runs with a
/// thousand seeds would contain a million seeds.
pub(super) fn command_of(command: &str, spec: &RunSpec) -> String {
    let Some(words) = shlex::split(command) else { return command.to_owned() };
    let own: Vec<String> = words.iter().map(|word| spec.own_override(word)).collect();
    quoted(own.iter().map(String::as_str))
}

/// The command without its option `--results`, which may name a folder of the machine. Published copies of runs keep
/// such a command, because they lie in another folder.
pub(super) fn without_results(command: &str) -> String {
    const OPTION: &str = "--results";
    let Some(words) = shlex::split(command) else { return command.to_owned() };
    let mut words = words.iter().map(String::as_str);
    let mut kept = Vec::new();
    while let Some(word) = words.next() {
        match word.strip_prefix(OPTION) {
            Some("") => drop(words.next()),
            Some(value) if value.starts_with('=') => {}
            _ => kept.push(word),
        }
    }
    quoted(kept)
}
