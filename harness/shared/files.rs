//! Files that are written completely or not at all, and folders in which one process writes at a time.

use std::ffi::{CString, OsString};
use std::fs::{DirEntry, File, Metadata, OpenOptions, Permissions, TryLockError};
use std::io::{self, ErrorKind, Write};
use std::mem::MaybeUninit;
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;
use tempfile::NamedTempFile;

/// Prefix of the name of a file that is not complete yet.
pub const UNFINISHED: &str = ".unfinished-";
/// Number of random letters and digits in the name of such a file.
const RANDOM: usize = 6;
/// The file of a folder that a process locks while it works there. It is not deleted afterwards, and names the last
/// process.
pub const LOCK: &str = ".unfinished-lock";

/// How often a lock is tried before it counts as held, and the time between two attempts. [`FolderLock::holder`] takes
/// a lock for a moment.
const ATTEMPTS: usize = 10;
const PAUSE: Duration = Duration::from_millis(10);

/// A file could not be written.
#[derive(Debug, thiserror::Error)]
#[error("can't write {}: {source}", path.display())]
pub struct WriteError {
    /// The file.
    pub path: PathBuf,
    #[source]
    /// The error of the file system.
    pub source: io::Error,
}

/// Calls `write` with a temporary file next to `path`, flushes it to disk and renames it to `path`.
///
/// A reader of `path` sees the old file, the new file or no file, but never an incomplete file. If `path` is a device
/// or a pipe, `write` is called with it.
pub fn write_whole(path: &Path, write: impl FnOnce(&Path) -> io::Result<()>) -> Result<(), WriteError> {
    let attempt = || {
        // A link stays, and the file that it points to is replaced. A device or a pipe is written to.
        let path = &*real(path);
        if std::fs::metadata(path).is_ok_and(|about| !about.is_file() && !about.is_dir()) {
            return write(path);
        }
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        std::fs::create_dir_all(folder)?;
        let (_lock, temporary) = unfinished_file(folder)?.into_parts();
        let permissions = std::fs::metadata(&temporary)?.permissions();
        write(&temporary)?;
        // A writer that creates the file again may restrict its permissions to this user.
        std::fs::set_permissions(&temporary, permissions)?;
        std::fs::File::open(&temporary)?.sync_all()?;
        temporary.persist(path).map_err(|error| error.error)
    };
    attempt().map_err(|source| WriteError { path: path.to_owned(), source })
}

/// Creates an unfinished file in a folder, and locks it, so that no process removes it as [`abandoned`].
fn unfinished_file(folder: &Path) -> io::Result<NamedTempFile> {
    loop {
        let file = tempfile::Builder::new()
            .prefix(UNFINISHED)
            .rand_bytes(RANDOM)
            .permissions(Permissions::from_mode(0o666))
            .tempfile_in(folder)?;
        match file.as_file().try_lock() {
            // Another process has taken it for abandoned.
            Err(TryLockError::WouldBlock) => {}
            Ok(()) if !is_at(file.as_file(), file.path()) => {}
            // Some file systems have no locks.
            _ => return Ok(file),
        }
    }
}

/// The unfinished files in a folder that no process is writing: what killed processes have left.
pub fn abandoned(folder: &Path) -> Vec<PathBuf> {
    let is_unfinished = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        name.strip_prefix(UNFINISHED)
            .is_some_and(|end| end.len() == RANDOM && end.chars().all(|c| c.is_ascii_alphanumeric()))
    };
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    entries.filter(|path| is_unfinished(path) && lock_of_abandoned(path).is_some()).collect()
}

/// Removes an unfinished file, unless a process is writing it. Returns whether there is no such file any more.
pub fn remove_abandoned(path: &Path) -> Result<bool, WriteError> {
    let Some(_lock) = lock_of_abandoned(path) else { return Ok(!path.exists()) };
    std::fs::remove_file(path).map_err(|source| WriteError { path: path.to_owned(), source })?;
    Ok(true)
}

/// Locks an unfinished file that no process is writing.
fn lock_of_abandoned(path: &Path) -> Option<File> {
    let is_file = std::fs::symlink_metadata(path).is_ok_and(|about| about.is_file());
    let file = is_file.then(|| File::open(path).ok())??;
    (file.try_lock().is_ok() && is_at(&file, path)).then_some(file)
}

/// Returns the absolute path of a file or folder, with links resolved. What the path ends in need not exist.
pub fn real(path: &Path) -> PathBuf {
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    std::fs::canonicalize(&path).unwrap_or_else(|_| match (path.parent(), path.file_name()) {
        (Some(folder), Some(name)) => real(folder).join(name),
        _ => path,
    })
}

/// Returns the path of a file or folder relative to the folder that contains it; `None` if it is not in that folder.
/// The file or folder may itself be a link to elsewhere.
pub fn within(folder: &Path, path: &Path) -> Option<PathBuf> {
    let path = std::path::absolute(path).ok()?;
    let of_link = path.parent().zip(path.file_name()).map(|(parent, name)| real(parent).join(name));
    let folder = real(folder);
    let mut places = of_link.into_iter().chain([real(&path)]);
    places.find_map(|place| place.strip_prefix(&folder).ok().map(Path::to_owned))
}

/// The entries of a folder, sorted. Empty if the folder can't be read.
pub fn sorted(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.path()).collect();
    paths.sort();
    paths
}

/// The folders in a folder, sorted.
pub fn folders(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    // The kind of an entry is known without a look at it, unless it is a link.
    let is_folder = |entry: &DirEntry| match entry.file_type() {
        Ok(kind) if !kind.is_symlink() => kind.is_dir(),
        _ => entry.path().is_dir(),
    };
    let mut paths: Vec<PathBuf> = entries.filter(is_folder).map(|entry| entry.path()).collect();
    paths.sort();
    paths
}

/// Writes `bytes` to a file, completely or not at all.
pub fn write_bytes(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    write_whole(path, |file| std::fs::write(file, bytes))
}

/// A folder can't be locked.
#[derive(Debug, thiserror::Error)]
pub enum LockError {
    /// The lock file can't be made or opened.
    #[error("can't lock {}: {source}", path.display())]
    Unopened {
        /// The lock file of the folder.
        path: PathBuf,
        /// The error of the file system.
        #[source]
        source: io::Error,
    },
    /// The file system has no locks, or its server refuses them.
    #[error(
        "can't lock {}: {} refuses locks (flock: {source}); choose a results folder on a local disk with --results, or \
         have this file system mounted with locks (NFS 4, or NFS 3 with a lock daemon; Lustre with the option flock)",
        path.display(), FileSystem::described(path)
    )]
    Refused {
        /// The lock file of the folder.
        path: PathBuf,
        /// The error of the file system.
        #[source]
        source: io::Error,
    },
}

/// A lock on a folder. Only its holder writes to the folder, until this value is dropped.
///
/// It is an advisory lock (flock). The system releases it when the holder's process ends for any reason. Between
/// machines it works on NFS 4, where the server releases a dead client's locks after its lease (about 90 s), and on
/// file systems that support flock across nodes. Lustre must be mounted with `flock`, not `localflock`.
#[derive(Debug)]
pub struct FolderLock {
    file: File,
}

impl Drop for FolderLock {
    /// Unlocks the file. Closing it is not enough while a process that another thread is starting has it open, too.
    fn drop(&mut self) {
        let _ = self.file.unlock();
    }
}

impl FolderLock {
    /// Locks a folder, and removes the unfinished files of killed processes. Creates the folder if it does not exist.
    /// Returns `None` if this or another process has locked it already.
    ///
    /// # Errors
    /// When the folder can't be made, its lock can't be opened, or the file system refuses locks.
    pub fn attempt(folder: &Path) -> Result<Option<Self>, LockError> {
        let lock = Self::lock(folder, File::try_lock)?;
        if let Some(Self { file }) = &lock {
            // On a full disk the name can't be written, but the lock is valid.
            let _ = file.set_len(0).and_then(|()| (&*file).write_all(this_process().as_bytes()));
            remove_unfinished(folder);
        }
        Ok(lock)
    }

    /// Locks a folder together with other processes that share it. Returns `None` if one process has locked it alone.
    /// Unfinished files of other processes stay.
    ///
    /// # Errors
    /// When the folder can't be made, its lock can't be opened, or the file system refuses locks.
    pub fn attempt_shared(folder: &Path) -> Result<Option<Self>, LockError> {
        Self::lock(folder, File::try_lock_shared)
    }

    /// Returns the process that has locked a folder alone, such as `process 4711 on host`; `None` if there is none.
    /// Writes nothing.
    pub fn holder(folder: &Path) -> Option<String> {
        let path = folder.join(LOCK);
        match File::open(&path).ok()?.try_lock_shared() {
            Err(TryLockError::WouldBlock) => {
                let name = std::fs::read_to_string(&path).ok().filter(|name| !name.is_empty());
                Some(name.unwrap_or_else(|| ANOTHER.into()))
            }
            _ => None,
        }
    }

    /// Returns the process that has kept this one from locking a folder, like [`holder`](Self::holder), or `another
    /// process` if its name is not known.
    pub fn other(folder: &Path) -> String {
        Self::holder(folder).unwrap_or_else(|| ANOTHER.into())
    }

    /// Returns the process that has locked a folder, like [`holder`](Self::holder), or `another process` if processes
    /// share it; `None` if the folder is not locked. Writes nothing.
    pub fn in_use(folder: &Path) -> Option<String> {
        Self::holder(folder).or_else(|| {
            let path = folder.join(LOCK);
            // NFS locks a file for one process only if it was opened for writing.
            let file =
                OpenOptions::new().read(true).write(true).open(&path).or_else(|_| File::open(&path)).ok()?;
            matches!(is_locked(&file, File::try_lock), Ok(false)).then(|| ANOTHER.into())
        })
    }

    /// Unlocks the folder and removes the file of the lock. Errors are ignored, because a file that remains locks
    /// nothing.
    pub fn remove(self, folder: &Path) {
        let _ = std::fs::remove_file(folder.join(LOCK));
    }

    fn lock(folder: &Path, attempt: Attempt) -> Result<Option<Self>, LockError> {
        let path = folder.join(LOCK);
        let open = || {
            std::fs::create_dir_all(folder)?;
            // NFS locks a file for one process only if it was opened for writing, and for several only if it was opened
            // for reading.
            OpenOptions::new().create(true).read(true).write(true).truncate(false).open(&path)
        };
        for _ in 0..ATTEMPTS {
            let file = match open() {
                Ok(file) => file,
                // Another process has removed the folder meanwhile.
                Err(error) if error.kind() == ErrorKind::NotFound => continue,
                Err(error) if error.kind() == ErrorKind::AlreadyExists && !folder.is_file() => continue,
                Err(source) => return Err(LockError::Unopened { path, source }),
            };
            match is_locked(&file, attempt) {
                Ok(true) if !is_at(&file, &path) => {}
                Ok(true) => return Ok(Some(Self { file })),
                Ok(false) => return Ok(None),
                Err(source) => return Err(LockError::Refused { path, source }),
            }
        }
        Ok(None)
    }
}

/// The holder of a lock whose name is not known.
pub const ANOTHER: &str = "another process";

/// Tries to lock a file.
type Attempt = fn(&File) -> Result<(), TryLockError>;

/// Tries a lock several times. Returns whether it succeeded.
fn is_locked(file: &File, attempt: Attempt) -> io::Result<bool> {
    for number in 1..=ATTEMPTS {
        match attempt(file) {
            Ok(()) => return Ok(true),
            Err(TryLockError::WouldBlock) if number < ATTEMPTS => std::thread::sleep(PAUSE),
            Err(TryLockError::WouldBlock) => {}
            Err(TryLockError::Error(error)) => return Err(error),
        }
    }
    Ok(false)
}

/// Makes a folder if it is missing, and checks that files in it can be written and locked, with a temporary file. A
/// folder in which they can't is not made.
///
/// # Errors
/// When no file can be made in the folder, or its file system refuses locks.
pub fn check_writable(folder: &Path) -> Result<(), LockError> {
    let path = folder.to_owned();
    let missing: Vec<_> = folder.ancestors().take_while(|above| !above.exists()).collect();
    let checked = match std::fs::create_dir_all(folder).and_then(|()| tempfile::tempfile_in(folder)) {
        Ok(file) => file.lock().map_err(|source| LockError::Refused { path, source }),
        Err(source) => Err(LockError::Unopened { path, source }),
    };
    if checked.is_err() {
        missing.into_iter().for_each(|folder| drop(std::fs::remove_dir(folder)));
    }
    checked
}

/// A mounted file system.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FileSystem {
    /// The folder at which it is mounted.
    pub place: PathBuf,
    /// Its type, such as `ext4` or `nfs4`.
    pub kind: String,
}

impl FileSystem {
    /// The file system of a path in words: its type and where it is mounted.
    fn described(path: &Path) -> String {
        let mounts = std::fs::read_to_string("/proc/self/mountinfo").unwrap_or_default();
        let found = Self::of(&real(path), &mounts);
        found.map_or("its file system".to_owned(), |Self { place, kind }| {
            format!("the file system at {} ({kind})", place.display())
        })
    }

    /// The file system of an absolute path among `mounts`, which are listed as in proc_pid_mountinfo(5).
    pub fn of(path: &Path, mounts: &str) -> Option<Self> {
        let parsed = |line: &str| {
            let (mount, about) = line.split_once(" - ")?;
            let place = unescaped(mount.split(' ').nth(4)?);
            path.starts_with(&place).then_some(Self { place, kind: about.split(' ').next()?.to_owned() })
        };
        // Of several mounts at one place, the last one is seen.
        mounts.lines().filter_map(parsed).max_by_key(|mount| mount.place.components().count())
    }
}

/// A path in which spaces and other characters are written as in `\\040`, in octal digits.
fn unescaped(text: &str) -> PathBuf {
    let mut parts = text.split('\\');
    let mut bytes = parts.next().unwrap_or_default().as_bytes().to_vec();
    for part in parts {
        let code = part.get(..3).and_then(|digits| u8::from_str_radix(digits, 8).ok());
        bytes.extend(code);
        bytes.extend_from_slice(if code.is_some() { &part.as_bytes()[3..] } else { part.as_bytes() });
    }
    PathBuf::from(OsString::from_vec(bytes))
}

/// Whether an open file is the one at `path`.
fn is_at(file: &File, path: &Path) -> bool {
    let place = |about: Metadata| (about.dev(), about.ino());
    let (open, there) = (file.metadata().map(place), std::fs::metadata(path).map(place));
    matches!((open, there), (Ok(open), Ok(there)) if open == there)
}

fn this_process() -> String {
    let host = sysinfo::System::host_name().unwrap_or_else(|| "an unnamed host".into());
    format!("process {} on {host}", std::process::id())
}

/// Removes the unfinished files of a folder. The caller must hold its lock.
fn remove_unfinished(folder: &Path) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let name = entry.file_name();
        if name != LOCK && name.to_string_lossy().starts_with(UNFINISHED) {
            // A file that can't be removed only takes disk space.
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

/// Returns the free space, in bytes, that this user may use on the file system of `path`, which need not exist yet.
pub fn free_bytes(path: &Path) -> Option<u64> {
    let path = std::path::absolute(path).ok()?;
    let there = path.ancestors().find(|folder| folder.exists())?;
    let there = CString::new(there.as_os_str().as_bytes()).ok()?;
    let mut about = MaybeUninit::<libc::statvfs>::uninit();
    // SAFETY: the path ends in a null byte. `statvfs` fills in `about` if it returns 0.
    let about = unsafe {
        match libc::statvfs(there.as_ptr(), about.as_mut_ptr()) {
            0 => about.assume_init(),
            _ => return None,
        }
    };
    Some(about.f_bavail.saturating_mul(about.f_frsize))
}
