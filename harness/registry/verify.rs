//! Checks that every file of the results folder is as it was written, and suggests commands that repair damage.

use super::commands::{Again, Commands};
use super::folders::Recorded;
use super::merged::{Merged, NEW, RECORDS, lacks_list};
use super::record::{RunRecord, episodes_used};
use super::{RECORD, Registry, RegistryError, Status, UNCOMMITTED};
use crate::dataset::{Inspection, inspect, is_lock};
use harness_shared::files::{FolderLock, UNFINISHED, folders, sorted};
use harness_shared::numbers::counted;
use harness_shared::progress::Progress;
use harness_shared::{path_word, seal};
use harness_tables::read_footer;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

/// A problem with a file or folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// The file or folder.
    pub path: PathBuf,
    /// What is wrong with it.
    pub problem: String,
    /// A command that repairs it, if one is known.
    pub mend: Option<String>,
    /// Whether data were lost or changed. If not, the finding is only information.
    pub broken: bool,
}

/// The result of [`Registry::verify`].
#[derive(Debug, Default)]
pub struct Report {
    /// Number of run folders that were checked.
    pub runs: usize,
    /// Number of dataset folders that were checked.
    pub datasets: usize,
    /// Number of files that were checked.
    pub files: usize,
    /// The problems, in the order in which they were found.
    pub findings: Vec<Finding>,
}

impl Report {
    fn broken(&mut self, path: &Path, problem: impl Into<String>, mend: Option<String>) {
        let (path, problem) = (path.to_owned(), problem.into());
        self.findings.push(Finding { path, problem, mend, broken: true });
    }

    fn note(&mut self, path: &Path, problem: impl Into<String>, mend: Option<String>) {
        let (path, problem) = (path.to_owned(), problem.into());
        self.findings.push(Finding { path, problem, mend, broken: false });
    }
}

impl Registry {
    /// Checks every dataset and every run: seals, checksums, numbers of rows, missing files and files that do not
    /// belong there. Nothing is changed.
    pub fn verify(&self, progress: &dyn Progress) -> Report {
        let (datasets, runs) = (folders(&self.datasets()), self.run_folders());
        let has_merged = |folder: &PathBuf| folder.join(RECORDS).is_file() || lacks_list(folder);
        let merged: Vec<PathBuf> = folders(&self.runs()).into_iter().filter(has_merged).collect();
        let all = datasets.iter().chain(&runs).chain(&merged);
        let total = all.map(|folder| sorted(folder).len()).sum::<usize>();
        progress.begin("verifying", total as u64, "files");
        let recorded = self.recorded();
        let verification = Verification {
            registry: self,
            recorded: &recorded,
            used: episodes_used(recorded.iter().map(|(_, record)| record)),
            commands: Commands::new(self, &recorded),
            progress,
            files: AtomicUsize::new(0),
        };
        let without_folder: Vec<&Recorded> =
            recorded.iter().filter(|(folder, run)| run.is_merged() && !folder.is_dir()).collect();
        let (runs_there, datasets_there) = (runs.len() + without_folder.len(), datasets.len());
        let mut report = Report { runs: runs_there, datasets: datasets_there, ..Report::default() };
        datasets.iter().for_each(|folder| verification.dataset(folder, &mut report));
        verification.datasets_that_are_gone(&datasets, &mut report);
        merged.iter().for_each(|folder| verification.merged(folder, &mut report));
        let has_files = |(_, run): &&&Recorded| run.files.values().any(|file| file.slice.is_none());
        let lost = without_folder.iter().filter(has_files).map(|(folder, _)| folder);
        runs.iter().chain(lost).for_each(|folder| verification.run(folder, &mut report));
        verification.strays(&mut report);
        progress.end();
        Report { files: verification.files.into_inner(), ..report }
    }
}

/// A results folder that is being verified.
struct Verification<'a> {
    registry: &'a Registry,
    recorded: &'a [Recorded],
    /// Number of episodes of each dataset that finished runs used.
    used: BTreeMap<&'a str, u32>,
    commands: Commands<'a>,
    progress: &'a dyn Progress,
    files: AtomicUsize,
}

impl Verification<'_> {
    /// Counts a file that was checked.
    fn advance(&self) {
        self.files.fetch_add(1, Ordering::Relaxed);
        self.progress.advance(1);
    }

    fn dataset(&self, folder: &Path, report: &mut Report) {
        let (files, progress) = (&self.files, self.progress);
        let inspection = inspect(folder, &|| {
            files.fetch_add(1, Ordering::Relaxed);
            progress.advance(1);
        });
        let name = folder.file_name().unwrap_or_default().to_string_lossy();
        if inspection.outdated {
            let problem = "written in the format of another version, which this version can't read or check";
            return report.note(folder, problem, Some(remove(folder)));
        }
        if inspection.imported {
            return report_imported(folder, inspection, report);
        }
        // The command of the run that needs the most episodes restores them for all runs.
        let users = self
            .recorded
            .iter()
            .map(|(_, record)| record)
            .filter(|record| record.episodes_of(&name).is_some());
        let user = users.max_by_key(|record| (record.episodes_of(&name), record.spec.trained().is_some()));
        let again = user.map_or(Again::Unknown, |record| self.commands.collect(record));
        let collect = again.command();
        if let Some((path, problem)) = inspection.damaged_model {
            let lost = "; no run reads it, and collecting the dataset again writes it";
            report.broken(&path, again.explain(problem + lost), collect.clone());
        }
        if let Some(problem) = &inspection.undescribed
            && user.is_none()
        {
            return self.report_undescribed(folder, problem, report);
        }
        let described = inspection.undescribed.map(|problem| (folder.join("dataset.json"), problem));
        for (path, problem) in described.into_iter().chain(inspection.damaged) {
            let mend = collect.as_ref().map(|command| in_its_place(&path, command));
            let mend = mend.or_else(|| user.is_none().then(|| remove(&path)));
            report.broken(&path, again.explain(problem), mend);
        }
        let needed = self.used.get(&*name).copied().unwrap_or_default();
        let lost = inspection.missing.iter().filter(|index| **index < needed).count();
        if lost > 0 {
            let problem = format!("missing episodes: {lost} of the {needed} that a finished run used");
            report.broken(folder, again.explain(problem), collect);
        } else if !inspection.missing.is_empty() {
            let problem = format!("{} to be collected", counted(inspection.missing.len(), "episode"));
            report.note(folder, problem, collect);
        }
        inspection.unknown.iter().for_each(|path| report_stray(path, report));
    }

    /// Reports a folder whose `dataset.json` is missing, damaged or of another dataset, and which no run refers to.
    fn report_undescribed(&self, folder: &Path, problem: &str, report: &mut Report) {
        if sorted(folder)
            .iter()
            .all(|path| path.file_name().is_some_and(|name| is_lock(&name.to_string_lossy())))
        {
            return report.note(
                folder,
                "a collection whose process ended before it collected anything",
                Some(remove(folder)),
            );
        }
        let own = stamped_dataset(folder).map(|name| self.registry.datasets().join(name));
        match own.filter(|own| own != folder) {
            Some(own) if !own.exists() => {
                let problem = format!("its episodes belong in {}, which does not exist", own.display());
                report.broken(folder, problem, Some(rename(folder, &own)));
            }
            Some(own) => {
                let problem =
                    format!("not used: its episodes belong in {}, which exists as well", own.display());
                report.broken(folder, problem, Some(remove(folder)));
            }
            None => report.broken(folder, format!("dataset.json: {problem}"), Some(remove(folder))),
        }
    }

    /// Reports missing datasets that finished runs used. This is no damage for published runs, whose datasets are not
    /// copied.
    fn datasets_that_are_gone(&self, there: &[PathBuf], report: &mut Report) {
        let there: BTreeSet<_> = there.iter().filter_map(|folder| folder.file_name()?.to_str()).collect();
        let records = || self.recorded.iter().map(|(_, record)| record);
        let is_gone = |record: &&RunRecord| {
            record.status == Status::Done && record.datasets().any(|(name, _)| !there.contains(name))
        };
        for name in self.used.keys().filter(|name| !there.contains(*name)) {
            let users = || records().filter(|record| record.episodes_of(name).is_some() && is_gone(record));
            let path = self.registry.datasets().join(name);
            let again: Vec<Again> = users().map(|record| self.commands.collect(record)).collect();
            let runs = counted(users().count(), "finished run");
            let problem = format!("{runs} used this dataset, which is not there");
            match again.iter().find_map(Again::command) {
                Some(collect) => report.broken(&path, problem, Some(collect)),
                None => {
                    let problem = again.first().map_or(problem.clone(), |again| again.explain(problem));
                    report.broken(&path, problem, None);
                }
            }
        }
        let published: Vec<_> = records().filter(|record| is_gone(record) && record.published).collect();
        if !published.is_empty() {
            let datasets: BTreeSet<_> = published.iter().map(|record| &record.dataset).collect();
            let [runs, datasets] = [(published.len(), "published run"), (datasets.len(), "dataset")]
                .map(|(count, noun)| counted(count, noun));
            let problem = format!("the folder has {runs} and lacks their {datasets}, as publishing does");
            report.note(&self.registry.datasets(), problem, None);
        }
    }

    /// Reports what is wrong with the files that an experiment's published runs share.
    fn merged(&self, experiment: &Path, report: &mut Report) {
        let path = experiment.join(RECORDS);
        let again = "; restore it from version control, or remove the folder and publish its runs again";
        self.advance();
        if !path.exists() {
            return report.broken(
                &path,
                format!("it is missing, and says which rows are of which run{again}"),
                None,
            );
        }
        let read = || {
            self.registry.published(experiment)?;
            Merged::read(experiment)
        };
        let merged = match read() {
            Ok(merged) => merged,
            Err(RegistryError::Misplaced { of, .. }) => {
                let own = self.registry.runs().join(of.split('/').next().unwrap_or_default());
                let mend = if own.exists() { remove(experiment) } else { rename(experiment, &own) };
                return report.broken(&path, format!("it is the record of {of}"), Some(mend));
            }
            Err(error) => return report.broken(&path, reason(error) + again, None),
        };
        for name in merged.tables.keys() {
            self.advance();
            if let Err(error) = merged.check(experiment, name) {
                report.broken(&experiment.join(name), reason(error) + again, None);
            }
        }
        for path in sorted(experiment).into_iter().filter(|path| !path.is_dir()) {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if merged.is_current(&path) && !merged.tables.contains_key(&*name) {
                let problem =
                    "a table that an interrupted command did not rename; the next `harness publish` does it";
                report.note(&path, problem, None);
            } else if !is_lock(&name) && name != RECORDS && !merged.tables.contains_key(&*name) {
                report_stray(&path, report);
            }
        }
    }

    fn run(&self, folder: &Path, report: &mut Report) {
        let path = folder.join(RECORD);
        // Without the list of published runs, it is not known which files belong to them. The list is reported once.
        if !path.is_file() && folder.parent().is_some_and(lacks_list) {
            return;
        }
        let record = match self.registry.read_run(folder) {
            Ok(Some(record)) => record,
            Ok(None) => {
                return report.note(
                    folder,
                    "a run whose process ended before it wrote anything",
                    Some(remove(folder)),
                );
            }
            Err(RegistryError::Misplaced { .. }) => return self.misplaced_run(folder, report),
            Err(error) => return self.unreadable_run(folder, &path, &reason(error), report),
        };
        self.advance();
        // The files that published runs share are checked once.
        for (name, _) in record.files.iter().filter(|(_, file)| file.slice.is_none()) {
            self.advance();
            if let Err(problem) = check_listed(&record, folder, name) {
                let path = folder.join(name);
                match self.commands.run(folder, Some(&record)) {
                    Again::Unknown => {
                        let reason = "no known command makes this run again, so it can only be removed";
                        report.broken(&path, format!("{problem}; {reason}"), Some(remove(folder)));
                    }
                    again => {
                        let mend = again.command().map(|command| in_its_place(&path, &command));
                        report.broken(&path, again.explain(problem), mend);
                    }
                }
            }
        }
        for path in sorted(folder) {
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let known = [RECORD, super::SPEC, UNCOMMITTED].contains(&name.as_str()) || is_lock(&name);
            if known || record.files.contains_key(&name) {
                continue;
            }
            self.advance();
            let may_grow = record.status != Status::Done || record.spec.may_continue();
            if !may_grow || !record.expects(&name) {
                report_stray(&path, report);
            } else if let Err(error) = seal::read(&path) {
                report.broken(&path, error.to_string(), Some(remove(&path)));
            }
        }
    }

    /// Reports a folder whose record is damaged or missing. If its command is known, the run can be done again there.
    fn unreadable_run(&self, folder: &Path, path: &Path, problem: &str, report: &mut Report) {
        let inner = folders(folder);
        if let Some(inner) = inner.first() {
            let problem = format!(
                "not a run: it contains folders such as {}; runs belong in runs/EXPERIMENT/RUN",
                inner.display()
            );
            return report.broken(folder, problem, None);
        }
        match self.commands.run(folder, None) {
            Again::Unknown => report.broken(path, problem, Some(remove(folder))),
            again => report.broken(path, again.explain(problem.to_owned()), again.command()),
        }
    }

    /// Reports a folder that contains the record of another run.
    fn misplaced_run(&self, folder: &Path, report: &mut Report) {
        let path = folder.join(RECORD);
        let Ok(Some(record)) = RunRecord::read(&path) else { return };
        let own = self.registry.folder_of(&record).path;
        let problem = format!("it is the record of {}", record.name());
        let mend = match self.commands.run(folder, None) {
            Again::Command(run) => run,
            _ if own.exists() => remove(folder),
            _ => rename(folder, &own),
        };
        report.broken(&path, problem, Some(mend));
    }

    /// Reports files that belong neither to a dataset nor to a run.
    fn strays(&self, report: &mut Report) {
        let experiments = folders(&self.registry.runs());
        let is_other = |folder: &PathBuf| {
            ![RECORD, RECORDS].iter().any(|name| folder.join(name).is_file()) && !lacks_list(folder)
        };
        let experiments = experiments.into_iter().filter(is_other);
        let places = [self.registry.datasets(), self.registry.runs()].into_iter().chain(experiments);
        for path in places.flat_map(|place| sorted(&place)).filter(|path| !path.is_dir()) {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if !is_lock(&name) {
                report_stray(&path, report);
            }
        }
    }
}

/// Reports what is wrong with an imported dataset, which can't be collected again.
fn report_imported(folder: &Path, inspection: Inspection, report: &mut Report) {
    let again = "; remove the folder and import its mapping again";
    for (path, problem) in inspection.damaged {
        report.broken(&path, problem + again, None);
    }
    if !inspection.missing.is_empty() {
        let missing = counted(inspection.missing.len(), "missing episode");
        report.broken(folder, format!("it has {missing}{again}"), None);
    }
    inspection.unknown.iter().for_each(|path| report_stray(path, report));
}

/// The dataset that the metadata of every episode in a folder names, or `None` if they name none or several.
fn stamped_dataset(folder: &Path) -> Option<String> {
    let episodes =
        sorted(folder).into_iter().filter(|path| path.extension().is_some_and(|ending| ending == "parquet"));
    let names: Option<BTreeSet<String>> =
        episodes.map(|path| read_footer(&path).ok()?.stamp.remove("dataset")).collect();
    let mut names = names?.into_iter();
    names.next().filter(|_| names.next().is_none())
}

/// The reason of an error, without the file's path.
fn reason(error: RegistryError) -> String {
    match error {
        RegistryError::File { reason, .. } | RegistryError::Record { reason, .. } => reason,
        other => other.to_string(),
    }
}

/// Compares a file with its entry in the run's record.
fn check_listed(record: &RunRecord, folder: &Path, name: &str) -> Result<(), String> {
    let path = record.check_file(folder, name).map_err(reason)?;
    if let Some(rows) = record.files[name].settled(&path).rows {
        let footer = read_footer(&path).map_err(|error| error.to_string())?;
        if footer.rows != rows {
            return Err(format!("it has {} rows instead of {rows}", footer.rows));
        }
    }
    Ok(())
}

fn report_stray(path: &Path, report: &mut Report) {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let is_unfinished = name.starts_with(UNFINISHED) || name.ends_with(NEW);
    let is_in_use = || path.parent().is_some_and(|folder| FolderLock::in_use(folder).is_some());
    // A process that works in the folder writes the file, or has just renamed or removed it.
    if is_unfinished && (is_in_use() || !path.exists()) {
        return;
    }
    let problem =
        if is_unfinished { "left over from an interrupted write" } else { "not a file of the harness" };
    report.note(path, problem, Some(remove(path)));
}

fn remove(path: &Path) -> String {
    let option = if path.is_dir() { "-r " } else { "" };
    format!("rm {option}{}", path_word(path))
}

/// The command that makes a file, after the removal of a folder that stands in its place.
fn in_its_place(path: &Path, command: &str) -> String {
    if path.is_dir() { format!("{} && {command}", remove(path)) } else { command.to_owned() }
}

fn rename(from: &Path, to: &Path) -> String {
    let parent = to.parent().unwrap_or(Path::new("."));
    format!("mkdir -p {} && mv {} {}", path_word(parent), path_word(from), path_word(to))
}
