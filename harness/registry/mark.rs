//! A file's inode, size and times, which tell whether the file may have changed.

use serde::{Deserialize, Serialize};
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// The age from which a file's times show every later change. Two writes within one tick of the file system's clock get
/// the same time.
const SETTLED: Duration = Duration::from_secs(2);

/// A file's inode, size and times. Every write to the file changes them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Mark {
    inode: u64,
    /// Size of the file in bytes.
    pub bytes: u64,
    /// Seconds and nanoseconds.
    modified: (i64, i64),
    changed: (i64, i64),
}

impl Mark {
    /// The mark of a file, or `None` if there is no such file.
    pub fn of(path: &Path) -> Option<Self> {
        let of = std::fs::metadata(path).ok()?;
        Some(Self {
            inode: of.ino(),
            bytes: of.len(),
            modified: (of.mtime(), of.mtime_nsec()),
            changed: (of.ctime(), of.ctime_nsec()),
        })
    }

    /// Whether the next write will change the mark.
    pub fn is_settled(&self) -> bool {
        let changed = UNIX_EPOCH + Duration::from_secs(self.changed.0.max(0) as u64 + 1);
        SystemTime::now().duration_since(changed).is_ok_and(|age| age >= SETTLED)
    }
}
