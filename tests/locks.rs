//! Locks of folders: several processes that look at them, share them, and remove folders.

use crate::common::{SMOKE, fresh, succeed};
use harness::files::{FileSystem, FolderLock, LOCK};
use std::fs::File;
use std::io;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, Output};
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
    let lock = folder.join(LOCK).canonicalize().unwrap();
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
    // A process that another test is starting may have the file for a moment, so it is tried several times.
    assert!(attempt(&aside).is_some());
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

#[test]
fn the_file_system_of_a_path_is_the_last_one_mounted_nearest_to_it() {
    let mounts = "21 1 8:1 / / rw,relatime shared:1 - ext4 /dev/sda1 rw\n\
                  40 21 0:35 / /data\\040of\\040us rw master:2 - nfs server:/data rw,vers=3,nolock\n\
                  41 40 0:36 / /data\\040of\\040us rw - nfs4 server:/data rw\n";
    let of = |path: &str| FileSystem::of(Path::new(path), mounts).map(|found| (found.place, found.kind));
    assert_eq!(of("/data of us/runs"), Some(("/data of us".into(), "nfs4".into())));
    assert_eq!(of("/data of users"), Some(("/".into(), "ext4".into())));
}

/// Runs the program where every file system refuses locks with this error, by a filter of system calls.
fn without_locks(error: i32, results: &Path, arguments: &[&str]) -> Output {
    let statement = |code: u32, when: [u8; 2], k: u32| libc::sock_filter {
        code: code as u16,
        jt: when[0],
        jf: when[1],
        k,
    };
    let filter = [
        // The number of the call, which is the first field of its description.
        statement(libc::BPF_LD | libc::BPF_W | libc::BPF_ABS, [0, 0], 0),
        statement(libc::BPF_JMP | libc::BPF_JEQ | libc::BPF_K, [0, 1], libc::SYS_flock as u32),
        statement(libc::BPF_RET | libc::BPF_K, [0, 0], libc::SECCOMP_RET_ERRNO | error as u32),
        statement(libc::BPF_RET | libc::BPF_K, [0, 0], libc::SECCOMP_RET_ALLOW),
    ];
    let mut command = Command::new(env!("CARGO_BIN_EXE_harness"));
    command.arg("--results").arg(results).args(arguments).current_dir(env!("CARGO_MANIFEST_DIR"));
    // SAFETY: nothing else is done between fork and exec, and the filter is a value of the closure.
    unsafe {
        command.pre_exec(move || {
            let program = libc::sock_fprog { len: filter.len() as u16, filter: filter.as_ptr().cast_mut() };
            let is_set = libc::prctl(libc::PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0
                && libc::prctl(libc::PR_SET_SECCOMP, libc::SECCOMP_MODE_FILTER, &raw const program) == 0;
            if is_set { Ok(()) } else { Err(io::Error::last_os_error()) }
        })
    };
    command.output().unwrap()
}

#[test]
fn a_file_system_that_refuses_locks_is_named_before_anything_is_done() {
    let above = fresh("lock-refused");
    std::fs::create_dir_all(&above).unwrap();
    let results = above.join("results");
    let df = Command::new("df").args(["--output=fstype"]).arg(&above).output().unwrap().stdout;
    let kind = String::from_utf8(df).unwrap().lines().last().unwrap().trim().to_owned();
    for error in [libc::ENOSYS, libc::ENOLCK, libc::EOPNOTSUPP, libc::EIO] {
        for arguments in [&["run", SMOKE][..], &["collect", SMOKE], &["doctor"]] {
            let output = without_locks(error, &results, arguments);
            assert_eq!(output.status.code(), Some(1), "{arguments:?}");
            let said = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap()).concat();
            let said = said.split_whitespace().collect::<Vec<_>>().join(" ");
            for part in [
                &format!("can't lock {}: the file system at /", results.display()),
                &format!(" ({kind}) refuses locks (flock: {})", io::Error::from_raw_os_error(error)),
                "on a local disk with --results",
            ] {
                assert!(said.contains(part), "{arguments:?} does not say {part}: {said}");
            }
            assert_eq!(std::fs::read_dir(&above).unwrap().count(), 0, "{arguments:?} wrote something");
        }
    }
    // A judgment is refused before its run has a folder.
    let of = ["scenarios=[empty]", "input=[proprioception]", "output=[proprioception]", "window.horizon=5"];
    succeed(&results, &[&["collect", SMOKE][..], &of].concat());
    let output = without_locks(libc::ENOLCK, &results, &[&["judge", SMOKE, "simulator"][..], &of].concat());
    assert!(String::from_utf8(output.stderr).unwrap().contains("refuses locks"));
    assert!(!results.join("runs").exists());
    // A folder that is there is locked before it is removed.
    let output = without_locks(libc::ENOLCK, &results, &["gc", "--only", "unused", "--yes"]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.code() == Some(1) && said.contains("refuses locks"), "{said}");
    assert_eq!(std::fs::read_dir(results.join("datasets")).unwrap().count(), 1);
}
