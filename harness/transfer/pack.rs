//! Packs: runs with their networks, and their datasets if asked for, in one sealed file.
//!
//! A pack is a plain tar archive. Its first file, `manifest.json`, lists the size and the SHA-256 of all others, which
//! follow in the same order. Their paths are those in the results folder.
//!
//! ```text
//! manifest.json                   format, versions, files; with a seal
//! datasets/<name>/                dataset.json, model.xml, episode_00000.parquet …
//! runs/<experiment>/<run id>/     run.json, spec.yaml, tables, networks
//! ```

use super::Busy;
use harness_dataset::{Dataset, MODEL, inspect, is_lock};
use harness_registry::{
    FileRecord, RECORD, Recorded, Registry, RegistryError, RunRecord, Status, UNCOMMITTED, Versions,
};
use harness_shared::files::{
    FolderLock, LockError, UNFINISHED, WriteError, abandoned, free_bytes, remove_abandoned, sorted,
    write_whole,
};
use harness_shared::numbers::{bytes as size, counted};
use harness_shared::progress::Progress;
use harness_shared::seal;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{self, BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// The format of the packs that this version reads and writes.
const FORMAT: u64 = 1;
/// The name of a pack's first file.
const MANIFEST: &str = "manifest.json";
/// The maximum size of a manifest in bytes. The runs of a million files have a smaller one.
const MOST_MANIFEST: u64 = 1 << 28;
/// The size of a tar archive is a multiple of this, in bytes.
const TAR_BLOCK: u64 = 512;
/// The zeros at the end of a tar archive, in bytes.
const END: usize = 1024;
/// The space that a file takes on a disk is a multiple of this, in bytes.
const BLOCK: u64 = 4096;
/// The file that describes a dataset.
const DESCRIPTION: &str = "dataset.json";

/// Why runs can't be packed or unpacked.
#[derive(Debug, thiserror::Error)]
pub enum PackError {
    /// A run or a dataset is damaged or missing.
    #[error(transparent)]
    Registry(#[from] RegistryError),
    /// A file can't be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// A folder can't be locked.
    #[error(transparent)]
    Lock(#[from] LockError),
    /// The pack's name is taken.
    #[error("{} exists already; name another file, or remove it", .0.display())]
    Exists(PathBuf),
    /// None of the chosen runs is done.
    #[error("none of these runs is done, so there is nothing to pack; `{0}` shows why")]
    NotDone(String),
    /// The pack can't be read.
    #[error("can't read {}: {reason}", path.display())]
    Read {
        /// The pack.
        path: PathBuf,
        /// The error of the file system.
        reason: io::Error,
    },
    /// The file is no pack, or one that the harness did not write.
    #[error("{} is not a pack of the harness: {reason}", path.display())]
    NotAPack {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The pack has the format of another version.
    #[error(
        "{} has format {found}, which harness {made_by} wrote; this is harness {}, which reads format {FORMAT}: unpack \
         it with that version",
        path.display(), env!("CARGO_PKG_VERSION")
    )]
    Format {
        /// The pack.
        path: PathBuf,
        /// Its format.
        found: String,
        /// The version that wrote it.
        made_by: String,
    },
    /// The pack is not as it was written.
    #[error("{} is damaged: {reason}; nothing was unpacked, copy or pack it again", path.display())]
    Damaged {
        /// The pack.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A folder of the pack can't be read by this version.
    #[error("{} can't be used: {folder}: {reason}; nothing was unpacked. It was packed by harness \
             {made_by}", path.display())]
    Unusable {
        /// The pack.
        path: PathBuf,
        /// The folder of a run or a dataset.
        folder: String,
        /// What is wrong with it.
        reason: String,
        /// The version that wrote the pack.
        made_by: String,
    },
    /// Folders of the pack exist, with other content.
    #[error(
        "{} exists already with other content ({file}){}; nothing was unpacked. Unpack into another folder with \
         --results, or remove what is there",
        folder.display(), and_more(*.others)
    )]
    Differs {
        /// The first of these folders.
        folder: PathBuf,
        /// A file in it that differs or is missing.
        file: String,
        /// Number of other folders that differ.
        others: usize,
    },
    /// Another process works in a folder.
    #[error(transparent)]
    Busy(#[from] Busy),
    /// The files do not fit on the disk.
    #[error(
        "the files take {} in {}, and only {} are free there; make room, or choose a folder on another disk",
        size(*needed), folder.display(), size(*free)
    )]
    Disk {
        /// The folder on that disk.
        folder: PathBuf,
        /// Disk space that the files need, bytes.
        needed: u64,
        /// Disk space that is free, bytes.
        free: u64,
    },
    /// The caller cancelled the work.
    #[error("it was cancelled; nothing was changed")]
    Cancelled,
}

fn and_more(others: usize) -> String {
    if others == 0 { String::new() } else { format!(", and so do {others} more") }
}

/// What was packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Packed {
    /// Number of runs.
    pub runs: usize,
    /// Number of datasets.
    pub datasets: usize,
    /// Number of files.
    pub files: usize,
    /// Size of the pack, bytes.
    pub bytes: u64,
}

/// What was unpacked.
#[derive(Debug)]
pub struct Unpacked {
    /// Number of runs that were not there before.
    pub runs: usize,
    /// Number of datasets that were not there before, or not completely.
    pub datasets: usize,
    /// Number of runs and datasets that were there before, with the same content.
    pub same: usize,
    /// For each dataset that the pack's runs used and that is missing, the run that used the most episodes.
    pub lacking: Vec<RunRecord>,
}

/// The list of a pack's files.
#[derive(Debug, Serialize, Deserialize)]
struct Manifest {
    format: u64,
    harness_version: String,
    mujoco_version: String,
    candle_version: String,
    /// The files by their path in the results folder, in the order in which they follow.
    files: BTreeMap<String, FileRecord>,
}

impl Manifest {
    fn sealed(&self) -> Vec<u8> {
        let mut json = serde_json::to_value(self).expect("a manifest is plain data");
        json[seal::KEY] = seal::BLANK.into();
        let mut bytes = format!("{json:#}\n").into_bytes();
        seal::seal(&mut bytes).expect("it has a place for the seal");
        bytes
    }

    /// The files of each folder, by their names.
    fn folders(&self) -> BTreeMap<&str, Vec<(&str, &FileRecord)>> {
        let mut folders = BTreeMap::<_, Vec<_>>::new();
        for (path, file) in &self.files {
            let folder = folder_of(path);
            folders.entry(folder).or_default().push((&path[folder.len() + 1..], file));
        }
        folders
    }
}

/// The folder of the file at a path in a pack.
fn folder_of(path: &str) -> &str {
    path.rsplit_once('/').map_or("", |(folder, _)| folder)
}

/// Whether a path is that of a run's or a dataset's file in the results folder, and so leads nowhere else.
fn is_place(path: &str) -> bool {
    let parts: Vec<&str> = path.split('/').collect();
    let is_name =
        |part: &&str| !part.is_empty() && !part.starts_with('.') && !part.contains(char::is_control);
    matches!(parts[..], ["runs", _, _, _] | ["datasets", _, _]) && parts.iter().all(is_name)
}

fn is_run(folder: &str) -> bool {
    folder.starts_with("runs/")
}

/// The space that files take on a disk, bytes.
fn space<'a>(files: impl Iterator<Item = &'a FileRecord>) -> u64 {
    files.fold(0, |sum: u64, file| sum.saturating_add(file.bytes.div_ceil(BLOCK).saturating_mul(BLOCK)))
}

fn check_room(folder: &Path, needed: u64) -> Result<(), PackError> {
    match free_bytes(folder) {
        Some(free) if free < needed => Err(PackError::Disk { folder: folder.to_owned(), needed, free }),
        _ => Ok(()),
    }
}

// --- packing ---

/// Writes finished runs to the new file `output`: records, specs, tables and networks, and with `datasets` also the
/// datasets that they used.
///
/// # Errors
/// When `output` exists, no run is done, a file is damaged or missing, the disk is too small, or the caller
/// cancels. There is no file `output` then.
pub fn pack(
    registry: &Registry,
    runs: &[Recorded],
    datasets: bool,
    versions: Versions,
    output: &Path,
    progress: &dyn Progress,
) -> Result<Packed, PackError> {
    if output.symlink_metadata().is_ok() {
        return Err(PackError::Exists(output.to_owned()));
    }
    let runs: Vec<&Recorded> = runs.iter().filter(|(_, record)| record.status == Status::Done).collect();
    if runs.is_empty() {
        return Err(PackError::NotDone(registry.command("ls")));
    }
    let used = if datasets { episodes_of(&runs) } else { BTreeMap::new() };
    let mut files = BTreeMap::new();
    for (folder, record) in &runs {
        files.extend(run_files(folder, record)?);
    }
    if datasets {
        progress.begin("checking", used.len() as u64, "datasets");
        for (name, episodes) in &used {
            files.extend(dataset_files(registry, name, *episodes)?);
            progress.advance(1);
        }
        progress.end();
    }
    let manifest = Manifest {
        format: FORMAT,
        harness_version: env!("CARGO_PKG_VERSION").into(),
        mujoco_version: versions.mujoco.into(),
        candle_version: versions.candle.into(),
        files,
    };
    let folder = output.parent().filter(|folder| !folder.as_os_str().is_empty());
    check_room(folder.unwrap_or(Path::new(".")), space(manifest.files.values()))?;
    // A file that can't be removed only takes disk space.
    abandoned(folder.unwrap_or(Path::new("."))).iter().for_each(|left| drop(remove_abandoned(left)));
    let mut refused = None;
    let written = write_whole(output, |file| {
        write_pack(registry, &manifest, file, progress)?.map_err(|error| {
            refused = Some(error);
            io::Error::other("it was not packed")
        })
    });
    if let Some(error) = refused {
        return Err(error);
    }
    written?;
    let bytes = output.metadata().map_or(0, |about| about.len());
    Ok(Packed { runs: runs.len(), datasets: used.len(), files: manifest.files.len(), bytes })
}

/// Writes a pack. The inner error is that of a file that is packed, and the outer one that of the pack.
fn write_pack(
    registry: &Registry,
    manifest: &Manifest,
    file: &Path,
    progress: &dyn Progress,
) -> io::Result<Result<(), PackError>> {
    let mut archive = tar::Builder::new(BufWriter::new(File::create(file)?));
    append(&mut archive, MANIFEST, &manifest.sealed())?;
    progress.begin("packing", manifest.files.len() as u64, "files");
    for (path, file) in &manifest.files {
        if progress.cancelled() {
            return Ok(Err(PackError::Cancelled));
        }
        match file.read(&registry.root().join(path)) {
            Ok(bytes) => append(&mut archive, path, &bytes)?,
            Err(error) => return Ok(Err(error.into())),
        }
        progress.advance(1);
    }
    archive.into_inner()?.flush()?;
    progress.end();
    Ok(Ok(()))
}

/// The files of a dataset of which runs used the first `used` episodes, by their path in the results folder.
fn dataset_files(
    registry: &Registry,
    name: &str,
    used: u32,
) -> Result<BTreeMap<String, FileRecord>, RegistryError> {
    let folder = registry.datasets().join(name);
    let found = inspect(&folder, &|| ());
    let path = folder.join(DESCRIPTION);
    if found.outdated {
        let reason = "it is in the format of another version".into();
        return Err(RegistryError::File { path, reason });
    }
    if let Some(reason) = found.undescribed {
        return Err(RegistryError::File { path, reason });
    }
    if let Some((path, reason)) = found.damaged.into_iter().chain(found.damaged_model).next() {
        return Err(RegistryError::File { path, reason });
    }
    let episodes = found.promised.max(used);
    let missing = (0..episodes).filter(|index| !found.whole.contains_key(index)).count();
    if missing > 0 {
        return Err(RegistryError::Incomplete { path: folder, missing, episodes });
    }
    let paths = found.whole.into_iter().filter(|(index, _)| *index < episodes).map(|(_, path)| path);
    let model = folder.join(MODEL);
    paths
        .chain([path])
        .chain(model.exists().then_some(model))
        .map(|path| listed(&format!("datasets/{name}"), &path))
        .collect()
}

/// The number of episodes that these runs used of each dataset; 0 for imported datasets.
fn episodes_of<'a>(runs: &[&'a Recorded]) -> BTreeMap<&'a str, u32> {
    let mut used = BTreeMap::new();
    for (_, record) in runs {
        for (dataset, episodes) in record.datasets() {
            let most = used.entry(dataset).or_default();
            *most = episodes.max(*most);
        }
    }
    used
}

/// The files of a run, by their path in the results folder.
fn run_files(folder: &Path, record: &RunRecord) -> Result<BTreeMap<String, FileRecord>, RegistryError> {
    let own = format!("runs/{}", record.name());
    let sealed = record.files.iter().map(|(name, file)| Ok((format!("{own}/{name}"), file.clone())));
    let others = [RECORD, UNCOMMITTED].map(|name| folder.join(name)).into_iter();
    sealed.chain(others.filter(|path| path.exists()).map(|path| listed(&own, &path))).collect()
}

/// A file with its path in the results folder.
fn listed(folder: &str, path: &Path) -> Result<(String, FileRecord), RegistryError> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let bytes = std::fs::read(path)
        .map_err(|error| RegistryError::File { path: path.to_owned(), reason: error.to_string() })?;
    Ok((format!("{folder}/{name}"), FileRecord::of(&bytes, None)))
}

/// Appends a file whose header depends on nothing but its name and size, so that packing twice gives the same bytes.
fn append(archive: &mut tar::Builder<impl Write>, path: &str, bytes: &[u8]) -> io::Result<()> {
    let mut header = tar::Header::new_gnu();
    header.set_size(bytes.len() as u64);
    header.set_mode(0o644);
    archive.append_data(&mut header, path, bytes)
}

// --- unpacking ---

/// A pack whose manifest has been read and checked.
struct Pack<'a> {
    path: &'a Path,
    manifest: Manifest,
}

/// The runs, datasets and files of a pack that are not in the results folder yet.
#[derive(Default)]
struct New<'a> {
    /// Folders that do not exist, or contain nothing but a lock.
    folders: BTreeSet<&'a str>,
    /// Files that existing datasets lack.
    files: BTreeSet<String>,
    /// Number of folders that exist with the same content.
    same: usize,
}

/// How a folder of a pack compares with the same folder in the results folder.
enum There {
    /// It does not exist, or contains nothing but a lock.
    Nothing,
    /// All files are there with the same content.
    Same,
    /// These files of a dataset are missing.
    Lacks(Vec<String>),
    /// This file has other content, or a run lacks it.
    Differs(String),
}

impl New<'_> {
    fn contains(&self, path: &str) -> bool {
        self.files.contains(path) || self.folders.contains(folder_of(path))
    }

    /// The existing datasets that get further files.
    fn extended(&self) -> BTreeSet<&str> {
        self.files.iter().map(|path| folder_of(path)).collect()
    }

    /// All folders that are made or get further files.
    fn changed(&self) -> impl Iterator<Item = &str> {
        self.folders.iter().copied().chain(self.extended())
    }
}

/// Adds the runs and datasets of a pack to the results folder. Those that are there with the same content are
/// skipped.
///
/// All files are written to a folder of their own and checked first. Then each run and dataset is renamed to its
/// place as a whole.
///
/// # Errors
/// When the file is no pack, is damaged or has the format of another version, something in it exists with other
/// content, the disk is too small, or the caller cancels. Nothing is changed then. When a folder can't be renamed,
/// those before it stay, and the same call continues.
pub fn unpack(registry: &Registry, path: &Path, progress: &dyn Progress) -> Result<Unpacked, PackError> {
    let pack = Pack::open(path)?;
    let new = new_in(registry, &pack.manifest, progress)?;
    let is_new = |(path, _): &(&String, &FileRecord)| new.contains(path);
    let needed = space(pack.manifest.files.iter().filter(is_new).map(|(_, file)| file));
    check_room(registry.root(), needed)?;
    let existed = registry.root().exists();
    let moved = Staging::new(registry.root()).and_then(|staging| {
        pack.extract(&new, &staging, registry.root(), progress)?;
        pack.check(&new, &staging)?;
        move_in(registry, &new, &staging)
    });
    if moved.is_err() && !existed {
        // Fails unless it is empty.
        let _ = std::fs::remove_dir(registry.root());
    }
    moved?;
    let runs = new.folders.iter().filter(|folder| is_run(folder)).count();
    let datasets = new.changed().count() - runs;
    Ok(Unpacked { runs, datasets, same: new.same, lacking: lacking(registry, &pack.manifest) })
}

/// Compares a pack with the results folder.
fn new_in<'a>(
    registry: &Registry,
    manifest: &'a Manifest,
    progress: &dyn Progress,
) -> Result<New<'a>, PackError> {
    let (mut new, mut differing) = (New::default(), Vec::new());
    let folders = manifest.folders();
    progress.begin("comparing", folders.len() as u64, "folders");
    for (folder, files) in folders {
        if progress.cancelled() {
            return Err(PackError::Cancelled);
        }
        match compare(registry, folder, &files) {
            There::Nothing => drop(new.folders.insert(folder)),
            There::Same => new.same += 1,
            There::Lacks(files) => new.files.extend(files),
            There::Differs(file) => differing.push((registry.root().join(folder), file)),
        }
        progress.advance(1);
    }
    progress.end();
    let others = differing.len().saturating_sub(1);
    if let Some((folder, file)) = differing.into_iter().next() {
        return Err(PackError::Differs { folder, file, others });
    }
    for folder in new.changed() {
        let folder = registry.root().join(folder);
        if let Some(holder) = FolderLock::holder(&folder) {
            return Err(Busy { folder, holder }.into());
        }
    }
    Ok(new)
}

/// Compares a folder of a pack with the same folder here.
fn compare(registry: &Registry, folder: &str, files: &[(&str, &FileRecord)]) -> There {
    let target = registry.root().join(folder);
    if is_vacant(&target) {
        return There::Nothing;
    }
    let (there, missing): (Vec<_>, Vec<_>) = files.iter().partition(|(name, _)| target.join(name).exists());
    let differing = there.into_iter().find(|(name, file)| !is_same(&target, name, file));
    match differing.or(missing.first().copied().filter(|_| is_run(folder))) {
        Some((name, _)) => There::Differs((*name).to_owned()),
        None if missing.is_empty() => There::Same,
        None => There::Lacks(missing.iter().map(|(name, _)| format!("{folder}/{name}")).collect()),
    }
}

/// Renames the new folders and files from the staging folder to their places, datasets first.
fn move_in(registry: &Registry, new: &New, staging: &Staging) -> Result<(), PackError> {
    for path in &new.files {
        let target = registry.root().join(path);
        let _lock = lock(target.parent().unwrap_or(registry.root()))?;
        rename(&staging.path().join(path), &target)?;
    }
    for (index, folder) in new.folders.iter().enumerate() {
        let target = registry.root().join(folder);
        if target.exists() {
            let _lock = lock(&target)?;
            // A folder that contains a lock can't be replaced. If it contains anything else, it stays, and renaming
            // fails.
            if is_vacant(&target) {
                rename(&target, &staging.path().join(format!("vacant-{index}")))?;
            }
        }
        rename(&staging.path().join(folder), &target)?;
    }
    Ok(())
}

/// Returns a run for each dataset that runs of a pack used and that is missing.
fn lacking(registry: &Registry, manifest: &Manifest) -> Vec<RunRecord> {
    let mut users = BTreeMap::<String, (u32, RunRecord)>::new();
    for folder in manifest.folders().into_keys().filter(|folder| is_run(folder)) {
        let Ok(Some(record)) = registry.read_run(&registry.root().join(folder)) else { continue };
        for (dataset, episodes) in record.datasets() {
            if users.get(dataset).is_none_or(|(other, _)| *other < episodes) {
                users.insert(dataset.to_owned(), (episodes, record.clone()));
            }
        }
    }
    users.retain(|dataset, (episodes, record)| {
        !record.published && lacks_episodes(registry, dataset, *episodes)
    });
    users.into_values().map(|(_, record)| record).collect()
}

fn lacks_episodes(registry: &Registry, dataset: &str, used: u32) -> bool {
    let found = inspect(&registry.datasets().join(dataset), &|| ());
    let episodes = if found.imported { found.promised } else { used };
    found.undescribed.is_some() || (0..episodes).any(|index| !found.whole.contains_key(&index))
}

/// Whether a folder does not exist, or contains nothing but a lock.
fn is_vacant(folder: &Path) -> bool {
    let is_lock = |path: &PathBuf| path.file_name().is_some_and(|name| is_lock(&name.to_string_lossy()));
    folder.symlink_metadata().is_err() || folder.is_dir() && sorted(folder).iter().all(is_lock)
}

/// Whether a file of a pack is in its folder with the same content. Descriptions of a dataset may differ in the number
/// of episodes.
fn is_same(folder: &Path, name: &str, file: &FileRecord) -> bool {
    file.read(&folder.join(name)).is_ok() || name == DESCRIPTION && Dataset::at(folder).is_ok()
}

fn lock(folder: &Path) -> Result<FolderLock, PackError> {
    FolderLock::attempt(folder)?.ok_or_else(|| Busy::at(folder).into())
}

fn rename(from: &Path, to: &Path) -> Result<(), WriteError> {
    let place = to.parent().map_or(Ok(()), std::fs::create_dir_all);
    place
        .and_then(|()| std::fs::rename(from, to))
        .map_err(|source| WriteError { path: to.to_owned(), source })
}

/// The folder in which files are unpacked before they are moved. It is removed when this value is dropped, and by the
/// next unpacking if the process was killed.
struct Staging {
    // Fields are dropped in this order.
    _lock: FolderLock,
    folder: tempfile::TempDir,
}

impl Staging {
    fn new(root: &Path) -> Result<Self, PackError> {
        let prefix = format!("{UNFINISHED}unpack-");
        for left in sorted(root) {
            let is_staging = left.file_name().is_some_and(|name| name.to_string_lossy().starts_with(&prefix));
            // The lock is held until the folder is removed, because its process may be about to lock it.
            if is_staging && let Some(_lock) = FolderLock::attempt(&left)? {
                // A folder that can't be removed only takes disk space.
                let _ = std::fs::remove_dir_all(&left);
            }
        }
        let made = std::fs::create_dir_all(root)
            .and_then(|()| tempfile::Builder::new().prefix(&prefix).tempdir_in(root));
        let folder = made.map_err(|source| WriteError { path: root.to_owned(), source })?;
        Ok(Self { _lock: lock(folder.path())?, folder })
    }

    fn path(&self) -> &Path {
        self.folder.path()
    }
}

impl<'a> Pack<'a> {
    /// Opens a pack, and reads its manifest.
    fn open(path: &'a Path) -> Result<Self, PackError> {
        let unreadable = |reason| PackError::Read { path: path.to_owned(), reason };
        let no_pack = |reason: &str| PackError::NotAPack { path: path.to_owned(), reason: reason.into() };
        let damaged = |reason: String| PackError::Damaged { path: path.to_owned(), reason };
        let mut file = File::open(path).map_err(unreadable)?;
        let about = file.metadata().map_err(unreadable)?;
        if about.is_dir() {
            return Err(no_pack("it is a folder"));
        }
        let mut archive = tar::Archive::new(BufReader::new(&file));
        let first = archive.entries().ok().and_then(|mut entries| entries.next()?.ok());
        let first = first.filter(|entry| &*entry.path_bytes() == MANIFEST.as_bytes());
        let entry = first.ok_or_else(|| no_pack("it does not begin with manifest.json in a tar archive"))?;
        let (length, mut text) = (entry.size(), Vec::new());
        entry.take(MOST_MANIFEST).read_to_end(&mut text).map_err(unreadable)?;
        if text.len() as u64 != length {
            return Err(damaged(format!("its {MANIFEST} has {} bytes instead of {length}", text.len())));
        }
        seal::check(&text).map_err(|error| damaged(format!("{MANIFEST}: {error}")))?;
        let json: serde_json::Value =
            serde_json::from_slice(&text).map_err(|error| damaged(format!("{MANIFEST}: {error}")))?;
        if json["format"] != FORMAT {
            let made_by =
                json["harness_version"].as_str().unwrap_or("of another version").escape_debug().to_string();
            return Err(PackError::Format {
                path: path.to_owned(),
                found: json["format"].to_string(),
                made_by,
            });
        }
        let manifest: Manifest =
            serde_json::from_value(json).map_err(|error| no_pack(&format!("its {MANIFEST}: {error}")))?;
        if let Some(stray) = manifest.files.keys().find(|path| !is_place(path)) {
            let stray = stray.escape_debug();
            return Err(no_pack(&format!("'{stray}' is not the path of a run's or a dataset's file")));
        }
        let mut end = [1; END];
        let read = file.seek(SeekFrom::End(-(END as i64))).and_then(|_| file.read_exact(&mut end));
        if read.is_err() || end != [0; END] || !about.len().is_multiple_of(TAR_BLOCK) {
            return Err(damaged("its end is missing".into()));
        }
        Ok(Self { path, manifest })
    }

    /// Writes the new files of the pack to the staging folder. All files are compared with the manifest.
    fn extract(
        &self,
        new: &New,
        staging: &Staging,
        root: &Path,
        progress: &dyn Progress,
    ) -> Result<(), PackError> {
        let damaged = |reason: String| PackError::Damaged { path: self.path.to_owned(), reason };
        let broken = |error: io::Error| damaged(error.to_string());
        let file =
            File::open(self.path).map_err(|reason| PackError::Read { path: self.path.to_owned(), reason })?;
        let mut archive = tar::Archive::new(BufReader::new(file));
        let mut entries = archive.entries().map_err(broken)?.skip(1);
        progress.begin("unpacking", self.manifest.files.len() as u64, "files");
        for (path, file) in &self.manifest.files {
            if progress.cancelled() {
                return Err(PackError::Cancelled);
            }
            let entry =
                entries.next().ok_or_else(|| damaged(format!("{path} is missing")))?.map_err(broken)?;
            if &*entry.path_bytes() != path.as_bytes() || !entry.header().entry_type().is_file() {
                let found = String::from_utf8_lossy(&entry.path_bytes()).into_owned();
                let found = found.escape_debug();
                return Err(damaged(format!("it has {found} in the place of the file {path}")));
            }
            let mut bytes = Vec::new();
            entry.take(file.bytes.saturating_add(1)).read_to_end(&mut bytes).map_err(broken)?;
            file.check(&bytes).map_err(|reason| damaged(format!("{path}: {reason}")))?;
            if new.contains(path) {
                write(&staging.path().join(path), &bytes)
                    .map_err(|source| WriteError { path: root.join(path), source })?;
            }
            progress.advance(1);
        }
        if entries.next().is_some() {
            return Err(damaged(format!("it has files that its {MANIFEST} does not list")));
        }
        progress.end();
        Ok(())
    }

    /// Checks that this version can read the new runs and datasets, and that they belong in their folders.
    fn check(&self, new: &New, staging: &Staging) -> Result<(), PackError> {
        for folder in &new.folders {
            let staged = staging.path().join(folder);
            let problem =
                if is_run(folder) { self.run_fault(folder, &staged) } else { dataset_fault(&staged) };
            if let Some(reason) = problem {
                let (path, made_by) =
                    (self.path.to_owned(), self.manifest.harness_version.escape_debug().to_string());
                return Err(PackError::Unusable { path, folder: (*folder).to_owned(), reason, made_by });
            }
        }
        Ok(())
    }

    /// Why the folder of an unpacked run can't be used; `None` if it can.
    fn run_fault(&self, folder: &str, staged: &Path) -> Option<String> {
        let record = match RunRecord::read(&staged.join(RECORD)) {
            Ok(Some(record)) => record,
            Ok(None) => return Some(format!("{RECORD} is missing")),
            Err(RegistryError::Record { reason, .. }) => return Some(format!("{RECORD}: {reason}")),
            Err(error) => return Some(error.to_string()),
        };
        let is_packed = |(name, file): (&String, &FileRecord)| {
            self.manifest.files.get(&format!("{folder}/{name}")) == Some(file)
        };
        match folder {
            _ if folder != format!("runs/{}", record.name()) => {
                Some(format!("it contains {}", record.name().escape_debug()))
            }
            _ if record.status != Status::Done => Some(format!("the run is {}", record.status.name())),
            _ if !record.files.iter().all(is_packed) => Some(format!("{RECORD} lists other files")),
            _ => None,
        }
    }
}

/// Why the folder of an unpacked dataset can't be used; `None` if it can.
fn dataset_fault(staged: &Path) -> Option<String> {
    let found = inspect(staged, &|| ());
    let unknown = found.unknown.first().map(|path| (path, "not a file of a dataset".to_owned()));
    let mut damaged = found.damaged.iter().chain(&found.damaged_model);
    let damaged = damaged.next().map(|(path, problem)| (path, problem.clone()));
    match unknown.or(damaged) {
        _ if found.outdated => Some("it is in the format of another version".into()),
        _ if found.undescribed.is_some() => {
            found.undescribed.map(|problem| format!("{DESCRIPTION}: {problem}"))
        }
        Some((path, problem)) => Some(format!("{}: {problem}", path.file_name()?.to_string_lossy())),
        None if !found.missing.is_empty() => {
            Some(format!("it has {}", counted(found.missing.len(), "missing episode")))
        }
        None => None,
    }
}

/// Writes a new file to disk, with its folder.
fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    path.parent().map_or(Ok(()), std::fs::create_dir_all)?;
    let mut file = File::create_new(path)?;
    file.write_all(bytes)?;
    file.sync_all()
}
