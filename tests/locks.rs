//! Locks of folders: several processes that look at them, share them, and remove folders.

use crate::common::fresh;
use harness::files::{FolderLock, LOCK};
use std::fs::File;
use std::path::Path;
use std::time::Duration;

/// A part of the time for which a lock is tried.
const MOMENT: Duration = Duration::from_millis(30);

fn attempt(folder: &Path) -> Option<FolderLock> {
    FolderLock::attempt(folder).unwrap()
}

#[test]
fn a_lock_shared_by_processes_is_opened_to_read_and_write() {
    let folder = fresh("lock-modes");
    let _lock = FolderLock::attempt_shared(&folder).unwrap().unwrap();
    let lock = folder.join(LOCK);
    let descriptors = std::fs::read_dir("/proc/self/fd").unwrap().flatten();
    let is_lock = |path: &Path| std::fs::read_link(path).is_ok_and(|file| file == lock);
    let own = descriptors.map(|entry| entry.path()).find(|path| is_lock(path)).unwrap();
    let about = Path::new("/proc/self/fdinfo").join(own.file_name().unwrap());
    let about = std::fs::read_to_string(about).unwrap();
    let flags = about.lines().find_map(|line| line.strip_prefix("flags:")).unwrap().trim();
    assert_eq!(i32::from_str_radix(flags, 8).unwrap() & libc::O_ACCMODE, libc::O_RDWR, "{about}");
}

#[test]
fn a_look_at_a_lock_does_not_keep_others_from_taking_it() {
    let folder = fresh("lock-looked-at");
    drop(attempt(&folder));
    // On a busy machine, a look may take longer than all attempts.
    let is_taken = (0..20).any(|_| {
        let look = File::open(folder.join(LOCK)).unwrap();
        look.lock_shared().unwrap();
        let looking = std::thread::spawn(move || {
            std::thread::sleep(MOMENT);
            drop(look);
        });
        let lock = attempt(&folder);
        looking.join().unwrap();
        lock.is_some()
    });
    assert!(is_taken);
}

#[test]
fn a_lock_of_a_folder_that_is_removed_meanwhile_is_taken_again() {
    let folder = fresh("lock-removed");
    let aside = fresh("lock-set-aside");
    let lock = attempt(&folder).unwrap();
    let waits = {
        let folder = folder.clone();
        std::thread::spawn(move || (0..100).find_map(|_| attempt(&folder)))
    };
    std::thread::sleep(MOMENT);
    std::fs::rename(&folder, &aside).unwrap();
    drop(lock);
    let lock = waits.join().unwrap();
    assert!(lock.is_some());
    assert!(FolderLock::holder(&folder).is_some());
    assert!(FolderLock::holder(&aside).is_none());
}

#[test]
fn a_folder_that_processes_share_is_in_use() {
    let folder = fresh("lock-shared");
    assert_eq!(FolderLock::in_use(&folder), None);
    let shared = FolderLock::attempt_shared(&folder).unwrap().unwrap();
    assert_eq!(FolderLock::holder(&folder), None);
    assert_eq!(FolderLock::in_use(&folder).as_deref(), Some("another process"));
    drop(shared);
    assert_eq!(FolderLock::in_use(&folder), None);
    let _alone = attempt(&folder).unwrap();
    assert_eq!(FolderLock::in_use(&folder), FolderLock::holder(&folder));
    assert!(FolderLock::in_use(&folder).unwrap().starts_with(&format!("process {} on ", std::process::id())));
}
