//! Turns of processes that compute on the same cores.

use std::fs::{DirBuilder, File, OpenOptions, TryLockError};
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Time between two attempts to take a turn.
const INTERVAL: Duration = Duration::from_millis(20);

/// How long a process waits for its place in line. A process that is stopped there must not hold up the others forever.
const PATIENCE: Duration = Duration::from_secs(60);

/// Turns at computing, as many as computations fit on the cores that this process may use. Processes of the same user
/// that may use the same cores share them.
///
/// Processes that compute at the same time on one core displace each other's data from its caches. They take less time
/// in all if one computes after the other.
#[derive(Debug)]
pub struct Turns {
    folder: PathBuf,
    /// The machine, its cores, as in `0-3,8`, and the threads of a computation.
    name: String,
    count: usize,
}

/// A turn, until it is dropped or the process ends for any reason.
#[derive(Debug)]
pub struct Turn {
    /// `None` where files can't be locked: then everybody gets a turn.
    lock: Option<File>,
}

impl Drop for Turn {
    /// Unlocks the file. Closing it is not enough while a process that another thread is starting has it open, too.
    fn drop(&mut self) {
        let _ = self.lock.as_ref().map(File::unlock);
    }
}

impl Turns {
    /// Turns of computations with `threads` threads each, with lock files in a subfolder of `folder`. `None` if the
    /// system does not say which cores this process may use, or there can be no subfolder that only this user may write
    /// to: then nobody has to wait.
    pub fn new(folder: &Path, threads: usize) -> Option<Self> {
        let status = std::fs::read_to_string("/proc/self/status").ok()?;
        let cores = status.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:"))?.trim();
        let host = sysinfo::System::host_name()?;
        let user = std::fs::metadata("/proc/self").ok()?.uid();
        let folder = folder.join(format!("harness-turns-{user}"));
        let _ = DirBuilder::new().mode(0o700).create(&folder);
        let made = std::fs::symlink_metadata(&folder).ok()?;
        if !made.is_dir() || made.uid() != user || made.mode() & 0o022 != 0 {
            return None;
        }
        let count = (number_of(cores)? / threads.max(1)).max(1);
        Some(Self { folder, name: format!("{host}-cores-{cores}-threads-{threads}"), count })
    }

    /// The number of turns.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Takes a turn, and waits for it while `waits` returns true. Returns `None` if it returns false.
    pub fn take(&self, mut waits: impl FnMut() -> bool) -> Option<Turn> {
        // Only the first in line looks for a turn. So a process whose turn has ended does not pass those that wait.
        let begun = Instant::now();
        let mut line = self.lock("line");
        while line.is_none() && begun.elapsed() < PATIENCE {
            wait(&mut waits)?;
            line = self.lock("line");
        }
        loop {
            if let Some(turn) = (0..self.count).find_map(|number| self.lock(&number.to_string())) {
                return Some(turn);
            }
            wait(&mut waits)?;
        }
    }

    /// Locks a file. Returns `None` if it is locked already.
    fn lock(&self, name: &str) -> Option<Turn> {
        let path = self.folder.join(format!("{}-{name}", self.name));
        let Ok(file) = OpenOptions::new().create(true).write(true).truncate(false).open(path) else {
            return Some(Turn { lock: None });
        };
        match file.try_lock() {
            Ok(()) => Some(Turn { lock: Some(file) }),
            Err(TryLockError::WouldBlock) => None,
            Err(TryLockError::Error(_)) => Some(Turn { lock: None }),
        }
    }
}

/// Waits for a moment. Returns `None` if `waits` returns false.
fn wait(waits: &mut impl FnMut() -> bool) -> Option<()> {
    waits().then(|| std::thread::sleep(INTERVAL))
}

/// The number of cores in a list such as `0-3,8`.
fn number_of(cores: &str) -> Option<usize> {
    let length = |range: &str| {
        let (first, last) = range.split_once('-').unwrap_or((range, range));
        Some(last.parse::<usize>().ok()?.checked_sub(first.parse().ok()?)? + 1)
    };
    cores.split(',').map(length).sum()
}
