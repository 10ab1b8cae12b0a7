//! Whether everything in the results folder is as it was written, and what mends what is not.

use super::record::RunRecord;
use super::{RECORD, Registry, RegistryError, Status, UNCOMMITTED};
use crate::dataset::{Inspection, inspect, is_lock};
use crate::files::UNFINISHED;
use crate::progress::Progress;
use crate::seal;
use crate::tables::read_footer;
use std::cell::Cell;
use std::path::{Path, PathBuf};

/// Something that is not as it should be.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    pub path: PathBuf,
    pub problem: String,
    /// A command that mends it.
    pub mend: Option<String>,
    /// Whether something was lost or changed; if not, it is only worth knowing.
    pub broken: bool,
}

/// What was looked at, and what was found.
#[derive(Debug, Default)]
pub struct Report {
    pub runs: usize,
    pub datasets: usize,
    pub files: usize,
    pub findings: Vec<Finding>,
}

impl Report {
    fn broken(&mut self, path: &Path, problem: impl Into<String>, mend: String) {
        let (path, problem) = (path.to_owned(), problem.into());
        self.findings.push(Finding { path, problem, mend: Some(mend), broken: true });
    }

    fn note(&mut self, path: &Path, problem: impl Into<String>, mend: Option<String>) {
        let (path, problem) = (path.to_owned(), problem.into());
        self.findings.push(Finding { path, problem, mend, broken: false });
    }
}

impl Registry {
    /// Checks every dataset and every run: seals and checksums, numbers of rows, what is missing, what does not
    /// belong there. It changes nothing.
    pub fn verify(&self, progress: &dyn Progress) -> Report {
        let (datasets, runs) = (folders(&self.datasets()), self.run_folders());
        let entries = |folder: &PathBuf| sorted(folder).len();
        let total = datasets.iter().chain(&runs).map(entries).sum::<usize>();
        let mut report = Report { runs: runs.len(), datasets: datasets.len(), ..Report::default() };
        let files = Cell::new(0);
        let advance = || {
            files.set(files.get() + 1);
            progress.advance(1);
        };
        progress.begin("verifying", total as u64, "files");
        let recorded = self.recorded();
        for folder in &datasets {
            let inspection = inspect(folder, &advance);
            self.report_dataset(folder, inspection, &recorded, &mut report);
        }
        for folder in &runs {
            self.verify_run(folder, &advance, &mut report);
        }
        self.report_strays(&mut report);
        progress.end();
        Report { files: files.get(), ..report }
    }

    fn report_dataset(
        &self,
        folder: &Path,
        inspection: Inspection,
        recorded: &[(PathBuf, RunRecord)],
        report: &mut Report,
    ) {
        let name = folder.file_name().unwrap_or_default().to_string_lossy();
        if inspection.outdated {
            let problem = "in the format of another version, which this one neither reads nor checks";
            return report.note(folder, problem, Some(remove(folder)));
        }
        if inspection.imported {
            return report_imported(folder, inspection, report);
        }
        // Of all runs on this dataset, the one that needs the most of it.
        let users = recorded.iter().map(|(_, record)| record).filter(|record| record.dataset == name);
        let user = users.max_by_key(|record| (episodes(record), record.status == Status::Done));
        let collect = user.and_then(|record| self.again("collect", record));
        for (path, problem) in inspection.damaged {
            let mend = collect.clone().unwrap_or_else(|| remove(&path));
            report.broken(&path, problem, mend);
        }
        let needed = user.filter(|record| record.status == Status::Done);
        let needed = needed.map_or(0, episodes);
        let lost = inspection.missing.iter().filter(|index| **index < needed).count();
        if lost > 0 {
            let problem = format!("{lost} of the {needed} episodes that a finished run used are missing");
            let mend = collect.unwrap_or_else(|| "harness collect its experiment".into());
            report.broken(folder, problem, mend);
        } else if !inspection.missing.is_empty() {
            let problem = format!("{} episodes are not collected yet", inspection.missing.len());
            report.note(folder, problem, collect);
        }
        inspection.unknown.iter().for_each(|path| report_stray(path, report));
    }

    fn verify_run(&self, folder: &Path, advance: &dyn Fn(), report: &mut Report) {
        let path = folder.join(RECORD);
        let record = match RunRecord::read(&path) {
            Ok(Some(record)) => record,
            Ok(None) => {
                return report.broken(folder, format!("there is no {RECORD}"), self.anew(folder, None));
            }
            Err(error) => return report.broken(&path, reason(error), self.anew(folder, None)),
        };
        advance();
        if !folder.ends_with(Path::new(&record.experiment).join(&record.run)) {
            let problem = format!("it is the record of {}/{}", record.experiment, record.run);
            report.broken(&path, problem, self.anew(folder, None));
        }
        for name in record.files.keys() {
            advance();
            if let Err(problem) = check_listed(&record, folder, name) {
                report.broken(&folder.join(name), problem, self.anew(folder, Some(&record)));
            }
        }
        for path in sorted(folder) {
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let known = [RECORD, super::SPEC, UNCOMMITTED].contains(&name.as_str()) || is_lock(&name);
            if known || record.files.contains_key(&name) {
                continue;
            }
            advance();
            if record.status == Status::Done || !record.expects(&name) {
                report_stray(&path, report);
            } else if let Err(error) = seal::read(&path) {
                let mend = self.again("run", &record);
                let mend = mend.map_or_else(|| remove(&path), |run| format!("{} && {run}", remove(&path)));
                report.broken(&path, error.to_string(), mend);
            }
        }
    }

    /// What is neither a dataset nor a run.
    fn report_strays(&self, report: &mut Report) {
        let experiments = folders(&self.runs());
        let places = [self.datasets(), self.runs()].into_iter().chain(experiments);
        for path in places.flat_map(|place| sorted(&place)).filter(|path| !path.is_dir()) {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if !is_lock(&name) {
                report_stray(&path, report);
            }
        }
    }

    /// The command that makes a run anew.
    fn anew(&self, folder: &Path, record: Option<&RunRecord>) -> String {
        let run = record.and_then(|record| self.again("run", record));
        let run = run.unwrap_or_else(|| {
            let experiment = folder.parent().and_then(Path::file_name).unwrap_or_default();
            format!("harness run the spec of {}", experiment.to_string_lossy())
        });
        format!("{} && {run}", remove(folder))
    }

    /// The command that made a run, to be given again as `run` or as `collect`.
    fn again(&self, command: &str, record: &RunRecord) -> Option<String> {
        let mut words = record.provenance.command.split_whitespace().skip(1).peekable();
        let mut kept = Vec::new();
        while let Some(word) = words.next() {
            let is_setting = word.contains('=') && !word.starts_with('-');
            if word.ends_with(".yaml") || word.ends_with(".yml") || is_setting || word == "--quick" {
                kept.push(quoted(word));
            } else if word == "--models" {
                kept.extend([quoted(word), quoted(words.next()?)]);
            }
        }
        let has_spec = kept.iter().any(|word| word.contains(".yaml") || word.contains(".yml"));
        let results = match self.root.to_str() {
            Some("results") => String::new(),
            root => format!("--results {} ", quoted(root?)),
        };
        has_spec.then(|| format!("harness {results}{command} {}", kept.join(" ")))
    }
}

/// Episodes that a run simulated and used.
fn episodes(record: &RunRecord) -> u32 {
    record.spec.simulation.as_ref().map_or(0, |simulation| simulation.episodes)
}

/// What is wrong with a dataset that can only be imported again.
fn report_imported(folder: &Path, inspection: Inspection, report: &mut Report) {
    let mend = || format!("{} && harness import its mapping", remove(folder));
    for (path, problem) in inspection.damaged {
        report.broken(&path, problem, mend());
    }
    if !inspection.missing.is_empty() {
        report.broken(folder, format!("{} of its episodes are missing", inspection.missing.len()), mend());
    }
    inspection.unknown.iter().for_each(|path| report_stray(path, report));
}

/// What is wrong with a file, without its name.
fn reason(error: RegistryError) -> String {
    match error {
        RegistryError::File { reason, .. } | RegistryError::Record { reason, .. } => reason,
        other => other.to_string(),
    }
}

/// Compares a file with what the run's record says of it.
fn check_listed(record: &RunRecord, folder: &Path, name: &str) -> Result<(), String> {
    let path = record.check_file(folder, name).map_err(reason)?;
    if let Some(rows) = record.files[name].rows {
        let footer = read_footer(&path).map_err(|error| error.to_string())?;
        if footer.rows != rows {
            return Err(format!("it has {} rows instead of {rows}", footer.rows));
        }
    }
    Ok(())
}

fn report_stray(path: &Path, report: &mut Report) {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let problem = if name.starts_with(UNFINISHED) {
        "left over from a write that was interrupted"
    } else {
        "not a file of the harness"
    };
    report.note(path, problem, Some(remove(path)));
}

fn remove(path: &Path) -> String {
    let option = if path.is_dir() { "-r " } else { "" };
    format!("rm {option}{}", quoted(&path.display().to_string()))
}

/// A word as a shell takes it.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_-./=:,+@%".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        word.to_owned()
    } else {
        format!("'{}'", word.replace('\'', r"'\''"))
    }
}

fn sorted(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.path()).collect();
    paths.sort();
    paths
}

fn folders(folder: &Path) -> Vec<PathBuf> {
    sorted(folder).into_iter().filter(|path| path.is_dir()).collect()
}
