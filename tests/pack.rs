//! `harness pack` and `harness unpack`: a file with runs, from which any folder predicts the same, bit for bit. What
//! can't be packed or unpacked is refused in one line, and leaves everything as it was.

use crate::common::{Answer, Disk, FAILING, SMOKE, finish, fresh, harness, smoke_run, succeed};
use harness::dataset::Dataset;
use harness::experiment::{Model, Values};
use harness::files::{FolderLock, UNFINISHED};
use harness::progress::Silent;
use harness::registry::Registry;
use harness::samples::{FramePlace, Sample, physical};
use harness::seal;
use harness::transfer;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;
use std::fs;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{LazyLock, Mutex, PoisonError};
use std::time::Duration;
use tempfile::TempDir;

/// The smoke experiment's two runs and datasets.
static RESULTS: LazyLock<PathBuf> = LazyLock::new(|| smoke_run("packed-from"));

/// A pack of both runs without, and one with, the datasets.
static PACK: LazyLock<PathBuf> = LazyLock::new(|| pack("without.harness", &[]));
static WHOLE: LazyLock<PathBuf> = LazyLock::new(|| pack("with.harness", &["--datasets"]));

fn pack(name: &str, options: &[&str]) -> PathBuf {
    let folder = fresh(&format!("packs-{name}"));
    fs::create_dir(&folder).unwrap();
    let path = folder.join(name);
    succeed(&RESULTS, &[&["pack", "smoke", "--output", path.to_str().unwrap()], options].concat());
    path
}

fn unpack(results: &Path, pack: &Path) -> Answer {
    finish(&mut harness(results, &["unpack", pack.to_str().unwrap()]))
}

/// The bytes of every file below a folder except locks, by its path there.
fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    fn collect(root: &Path, folder: &Path, found: &mut BTreeMap<PathBuf, Vec<u8>>) {
        for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.is_dir() {
                collect(root, &path, found);
            } else if entry.file_name() != ".unfinished-lock" {
                found.insert(path.strip_prefix(root).unwrap().to_owned(), fs::read(&path).unwrap());
            }
        }
    }
    let mut found = BTreeMap::new();
    collect(folder, folder, &mut found);
    found
}

fn runs(results: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    files(&results.join("runs"))
}

/// The folder of the only run or dataset whose name begins with `prefix`.
fn child(folder: PathBuf, prefix: &str) -> PathBuf {
    let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let mut found = entries.filter(|path| path.file_name().unwrap().to_string_lossy().starts_with(prefix));
    found.next().unwrap()
}

fn csv(results: &Path, sql: &str) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("answer.csv");
    succeed(results, &["query", sql, "--output", path.to_str().unwrap()]);
    fs::read_to_string(path).unwrap()
}

/// The bits of everything that a run's network computes from samples of a dataset: posterior, prediction,
/// reconstruction.
fn computed(results: &Path, scenario: &str, datasets: &Path) -> Vec<u32> {
    let samples = Dataset::at(&child(datasets.join("datasets"), scenario)).unwrap();
    let samples = samples.load(FramePlace::Memory, &Silent).unwrap();
    let model = Model::load(&Registry::new(results), &format!("smoke/{scenario}")).unwrap();
    let spec = &model.record().spec;
    let at: Vec<Sample> = (0..samples.len()).filter(|sample| sample % 10 < 5).map(Sample::at).collect();
    let observed: Values =
        spec.input.iter().map(|&modality| (modality, physical(&samples, modality, &at))).collect();
    let action = at.iter().flat_map(|&sample| samples.action(spec.action, sample)).collect();
    let (mean, log_variance) = model.encode(at.len(), &observed).unwrap();
    let predicted = model.predict(at.len(), &observed, action).unwrap();
    let reconstructed = model.reconstruct(at.len(), mean.clone()).unwrap();
    let decoded = [predicted, reconstructed].into_iter().flat_map(BTreeMap::into_values);
    let all = [mean, log_variance].into_iter().chain(decoded).flatten();
    all.map(f32::to_bits).collect()
}

// --- what arrives ---

#[test]
fn unpacked_networks_compute_the_same_bits_and_commands_work() {
    let results = fresh("unpacked");
    let answer = unpack(&results, &PACK);
    assert_eq!(answer.code, 0, "{}", answer.stderr);
    assert!(answer.stdout.contains("2 runs and 0 datasets unpacked into "), "{}", answer.stdout);
    assert!(runs(&results) == runs(&RESULTS));
    for scenario in ["empty", "cluttered"] {
        let original = computed(&RESULTS, scenario, &RESULTS);
        assert!(
            original.len() > 100_000
                && original.iter().collect::<std::collections::BTreeSet<_>>().len() > 1000
        );
        assert!(computed(&results, scenario, &RESULTS) == original, "{scenario}");
    }
    for sql in [
        "select * from runs order by run",
        "select * from metrics order by run, task, model, modality, metric, index, direction",
    ] {
        assert_eq!(csv(&results, sql), csv(&RESULTS, sql));
    }
    let compared = succeed(&results, &["compare", "smoke"]);
    assert_eq!(compared, succeed(&RESULTS, &["compare", "smoke"]));
    let page = results.join("report.html");
    succeed(&results, &["report", "--output", page.to_str().unwrap()]);
    assert!(fs::read_to_string(page).unwrap().contains("smoke"));
    let verified = succeed(&results, &["verify"]);
    assert!(verified.ends_with("2 runs, 0 datasets, 18 files: all files are intact\n"), "{verified}");
    let plan = succeed(&results, &["run", SMOKE, "--dry-run"]);
    assert_eq!(plan.lines().filter(|line| line.starts_with("skip ")).count(), 2, "{plan}");
}

#[test]
fn datasets_come_along_if_they_are_asked_for() {
    let results = fresh("unpacked-whole");
    let answer = unpack(&results, &WHOLE);
    assert_eq!(answer.code, 0, "{}", answer.stderr);
    assert!(answer.stdout.starts_with("2 runs and 2 datasets unpacked into "), "{}", answer.stdout);
    assert!(files(&results) == files(&RESULTS));
    assert!(succeed(&results, &["verify"]).ends_with("all files are intact\n"));
    assert!(computed(&results, "cluttered", &results) == computed(&RESULTS, "cluttered", &RESULTS));
}

#[test]
fn the_suggested_command_collects_datasets_that_were_not_packed() {
    let folder = tempfile::tempdir().unwrap();
    let results = folder.path().join("it's all here");
    let said = unpack(&results, &PACK).stdout;
    let commands: Vec<&str> = said.lines().filter_map(|line| line.strip_prefix("  ")).collect();
    assert_eq!(commands.len(), 2, "{said}");
    let suggested = finish(&mut harness(&results, &["verify"])).stdout;
    for command in commands {
        assert!(suggested.contains(&format!("repair: {command}")), "{command}: {suggested}");
        let mut shell = assert_cmd::Command::new("sh");
        let own = Path::new(env!("CARGO_BIN_EXE_harness")).parent().unwrap();
        let programs = format!("{}:{}", own.display(), std::env::var("PATH").unwrap());
        let answer = finish(shell.args(["-c", command]).env("PATH", programs).current_dir(folder.path()));
        assert_eq!(answer.code, 0, "{command}: {}", answer.stderr);
    }
    assert!(files(&results.join("datasets")) == files(&RESULTS.join("datasets")));
    assert!(succeed(&results, &["verify"]).ends_with("all files are intact\n"));
}

#[test]
fn what_is_there_is_skipped_and_what_is_missing_is_added() {
    let results = fresh("unpacked-twice");
    unpack(&results, &PACK);
    let again = unpack(&results, &PACK);
    assert_eq!(again.code, 0, "{}", again.stderr);
    assert!(again.stdout.contains("0 runs and 0 datasets unpacked into "), "{}", again.stdout);
    assert!(again.stdout.contains(", 2 were there before\n"), "{}", again.stdout);
    let dataset = child(RESULTS.join("datasets"), "empty");
    let here = results.join("datasets").join(dataset.file_name().unwrap());
    fs::create_dir_all(&here).unwrap();
    for file in ["dataset.json", "episode_00001.parquet"] {
        fs::copy(dataset.join(file), here.join(file)).unwrap();
    }
    // A run whose process was killed before it wrote anything.
    let killed = child(results.join("runs/smoke"), "empty");
    fs::remove_dir_all(&killed).unwrap();
    drop(FolderLock::attempt(&killed).unwrap());
    let answer = unpack(&results, &WHOLE);
    assert_eq!(answer.code, 0, "{}", answer.stderr);
    assert!(answer.stdout.contains("1 run and 2 datasets unpacked into "), "{}", answer.stdout);
    assert!(files(&results.join("datasets")) == files(&RESULTS.join("datasets")));
    assert!(runs(&results) == runs(&RESULTS));
}

#[test]
fn a_pack_is_a_tar_archive_with_the_same_bytes_each_time() {
    let results = fresh("untarred");
    fs::create_dir(&results).unwrap();
    let tar = Command::new("tar").arg("-xf").arg(&*WHOLE).arg("-C").arg(&results).output().unwrap();
    assert!(tar.status.success(), "{}", String::from_utf8_lossy(&tar.stderr));
    let manifest: serde_json::Value =
        serde_json::from_slice(&fs::read(results.join("manifest.json")).unwrap()).unwrap();
    fs::remove_file(results.join("manifest.json")).unwrap();
    assert!(files(&results) == files(&RESULTS));
    assert_eq!(manifest["format"], 1);
    assert_eq!(manifest["mujoco_version"], harness::simulation::mujoco_version());
    for (path, bytes) in files(&results) {
        let listed = &manifest["files"][path.to_str().unwrap()];
        assert_eq!(listed["bytes"], bytes.len());
        let digest = <sha2::Sha256 as sha2::Digest>::digest(&bytes);
        assert_eq!(listed["sha256"], seal::hex(&digest));
    }
    assert!(fs::read(pack("again.harness", &["--datasets"])).unwrap() == fs::read(&*WHOLE).unwrap());
}

#[test]
fn packing_says_what_is_in_the_pack_and_how_to_unpack_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("my runs.harness");
    let said = succeed(&RESULTS, &["pack", "smoke/empty", "--output", path.to_str().unwrap()]);
    let lines: Vec<&str> = said.lines().collect();
    assert_eq!(lines.len(), 2, "{said}");
    let count = files(&child(RESULTS.join("runs/smoke"), "empty")).len();
    assert!(lines[0].starts_with(&format!("1 run, without their datasets: {count} files, ")), "{said}");
    assert_eq!(lines[1], format!("unpack it with: harness unpack '{}'", path.display()));
}

// --- what is refused ---

/// Checks that a command is refused with one line.
#[track_caller]
fn assert_refused(answer: &Answer, code: i32, expected: &str) {
    let line = answer.stderr.lines().last().unwrap_or_default();
    assert!(answer.code == code && line.contains(expected), "{}: {}", answer.code, answer.stderr);
    assert_eq!(answer.stderr.matches("error: ").count(), 1, "{}", answer.stderr);
    assert!(line.starts_with("error: ") && answer.stdout.is_empty(), "{}{}", answer.stdout, answer.stderr);
}

#[test]
fn a_refused_pack_is_one_line_and_writes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("it.harness");
    let refuse = |results: &Path, output: &Path, code: i32, expected: &str| {
        let arguments = ["pack", "smoke", "--datasets", "--output", output.to_str().unwrap()];
        assert_refused(&finish(&mut harness(results, &arguments)), code, expected);
    };
    fs::write(&output, "mine").unwrap();
    refuse(&RESULTS, &output, 2, "it.harness exists already; name another file, or remove it");
    assert_eq!(fs::read(&output).unwrap(), b"mine");
    fs::remove_file(&output).unwrap();
    refuse(Path::new("nowhere"), &output, 2, "there are no results in nowhere");
    let unknown = ["pack", "smok-", "--output", output.to_str().unwrap()];
    assert_refused(&finish(&mut harness(&RESULTS, &unknown)), 2, "no run matches 'smok-'");

    let results = fresh("unpackable");
    unpack(&results, &PACK);
    refuse(&results, &output, 1, "dataset.json is damaged (No such file");
    fs::remove_dir_all(&results).unwrap();
    unpack(&results, &WHOLE);
    let episode = child(child(results.join("datasets"), "empty"), "episode_00002");
    let bytes = fs::read(&episode).unwrap();
    fs::remove_file(&episode).unwrap();
    refuse(&results, &output, 1, "lacks 1 of its 4 episodes");
    fs::write(&episode, &bytes[1..]).unwrap();
    refuse(&results, &output, 1, "episode_00002.parquet is damaged");
    fs::write(&episode, &bytes).unwrap();
    let network = child(child(results.join("runs/smoke"), "empty"), "prediction.safetensors");
    fs::write(&network, "no network").unwrap();
    refuse(&results, &output, 1, "prediction.safetensors is damaged");
    assert!(fs::read_dir(folder.path()).unwrap().next().is_none());

    let failed = fresh("unpackable-failed");
    let arguments = [&["run", SMOKE, "--fail-fast"], &FAILING[..]].concat();
    assert_eq!(finish(&mut harness(&failed, &arguments)).code, 1);
    refuse(&failed, &output, 2, "none of these runs is done, so there is nothing to pack");
}

/// A file in a tar archive: its path, its bytes, its kind, and what it links to.
struct Entry(String, Vec<u8>, tar::EntryType, &'static str);

/// The pack without datasets with other entries.
fn rewritten(change: impl FnOnce(&mut Vec<Entry>)) -> (TempDir, PathBuf) {
    let mut archive = tar::Archive::new(fs::File::open(&*PACK).unwrap());
    let read = |entry: std::io::Result<tar::Entry<fs::File>>| {
        let mut entry = entry.unwrap();
        let (path, mut bytes) = (String::from_utf8(entry.path_bytes().into_owned()).unwrap(), Vec::new());
        std::io::Read::read_to_end(&mut entry, &mut bytes).unwrap();
        Entry(path, bytes, tar::EntryType::Regular, "")
    };
    let mut entries: Vec<Entry> = archive.entries().unwrap().map(read).collect();
    change(&mut entries);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("changed.harness");
    let mut archive = tar::Builder::new(fs::File::create(&path).unwrap());
    for Entry(path, bytes, kind, link) in entries {
        let mut header = tar::Header::new_gnu();
        header.set_size(bytes.len() as u64);
        header.set_mode(0o644);
        header.set_entry_type(kind);
        // `append_data` refuses paths that leave the folder.
        header.as_gnu_mut().unwrap().name[..path.len()].copy_from_slice(path.as_bytes());
        header.as_gnu_mut().unwrap().linkname[..link.len()].copy_from_slice(link.as_bytes());
        header.set_cksum();
        archive.append(&header, &*bytes).unwrap();
    }
    archive.into_inner().unwrap();
    (folder, path)
}

/// The pack with another manifest, which is sealed again.
fn with_manifest(change: impl FnOnce(&mut serde_json::Value)) -> (TempDir, PathBuf) {
    rewritten(|entries| change_manifest(&mut entries[0], change))
}

fn change_manifest(entry: &mut Entry, change: impl FnOnce(&mut serde_json::Value)) {
    let mut manifest: serde_json::Value = serde_json::from_slice(&entry.1).unwrap();
    change(&mut manifest);
    manifest["seal"] = seal::BLANK.into();
    entry.1 = manifest.to_string().into_bytes();
    seal::seal(&mut entry.1).unwrap();
}

/// The path of the first file of a pack without datasets.
fn first(manifest: &serde_json::Value) -> String {
    manifest["files"].as_object().unwrap().keys().next().unwrap().clone()
}

/// Checks that a pack is refused, and that a folder with other results and an empty folder stay as they are.
#[track_caller]
fn assert_pack_refused(pack: &Path, code: i32, expected: &str) {
    // One test at a time, because unpacking writes unfinished files before it refuses some packs.
    static OTHER: LazyLock<Mutex<PathBuf>> = LazyLock::new(|| {
        let results = fresh("unpacked-beside");
        let run = ["run", SMOKE, "scenarios=[empty]", "tasks=[prediction]", "training.epochs=1"];
        succeed(&results, &run);
        Mutex::new(results)
    });
    let other = OTHER.lock().unwrap_or_else(PoisonError::into_inner);
    let before = files(&other);
    assert_refused(&unpack(&other, pack), code, expected);
    assert!(files(&other) == before);
    let folder = tempfile::tempdir().unwrap();
    let results = folder.path().join("results");
    assert_refused(&unpack(&results, pack), code, expected);
    assert!(!results.exists());
}

#[test]
fn what_is_no_pack_of_this_version_is_refused_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    assert_pack_refused(&folder.path().join("nowhere.harness"), 2, "can't read ");
    assert_pack_refused(folder.path(), 2, "is not a pack of the harness: it is a folder");
    let text = folder.path().join("text.harness");
    for content in ["", "some text", &"long text ".repeat(1000)] {
        fs::write(&text, content).unwrap();
        assert_pack_refused(&text, 2, "it does not begin with manifest.json in a tar archive");
    }
    let (_folder, other) = rewritten(|entries| entries.swap(0, 1));
    assert_pack_refused(&other, 2, "it does not begin with manifest.json in a tar archive");
    let (_folder, later) = with_manifest(|manifest| {
        manifest["format"] = 2.into();
        manifest["harness_version"] = "9.0.0".into();
        manifest["files"] = "elsewhere".into();
    });
    assert_pack_refused(&later, 2, "has format 2, which harness 9.0.0 wrote; this is harness ");
    let (_folder, unlisted) = with_manifest(|manifest| manifest["files"] = "elsewhere".into());
    assert_pack_refused(&unlisted, 2, "is not a pack of the harness: its manifest.json: ");
}

#[test]
fn paths_that_leave_their_folder_are_refused() {
    let long = format!("runs/smoke/{}/../../../../../up", "x/".repeat(20));
    for path in [
        "../up",
        "/tmp/up",
        "runs/../../up/x",
        "runs/smoke/empty/../x",
        "runs/smoke//x",
        "runs/smoke/x",
        "runs/smoke/empty/.unfinished-lock",
        "datasets/../x",
        "datasets/x",
        "specs/x/y/z",
        "manifest.json",
        "",
        "runs/a/b/c/d",
        &long,
    ] {
        let (_folder, pack) = rewritten(|entries| {
            change_manifest(&mut entries[0], |manifest| {
                let first = first(manifest);
                let file = manifest["files"].as_object_mut().unwrap().remove(&first).unwrap();
                manifest["files"][path] = file;
            });
            entries[1].0 = path.chars().take(99).collect();
        });
        assert_pack_refused(&pack, 2, &format!("'{path}' is not the path of a run's or a dataset's file"));
    }
    // The manifest is right, and the archive is not.
    for path in ["../up", "/tmp/up"] {
        let (_folder, pack) = rewritten(|entries| entries[1].0 = path.to_owned());
        assert_pack_refused(&pack, 1, &format!("it has {path} in the place of the file runs/smoke/"));
    }
    for kind in
        [tar::EntryType::Symlink, tar::EntryType::Link, tar::EntryType::Directory, tar::EntryType::Fifo]
    {
        let (_folder, pack) = rewritten(|entries| {
            (entries[1].1, entries[1].2, entries[1].3) = (Vec::new(), kind, "/etc/passwd");
        });
        assert_pack_refused(&pack, 1, "in the place of the file runs/smoke/");
    }
}

#[test]
fn files_that_the_manifest_does_not_list_like_this_are_refused() {
    let (_folder, changed) = rewritten(|entries| entries[3].1[40] ^= 1);
    assert_pack_refused(
        &changed,
        1,
        "it has changed since it was written: its SHA-256 differs; nothing was unpacked",
    );
    let (_folder, shorter) = rewritten(|entries| entries[3].1.truncate(100));
    assert_pack_refused(&shorter, 1, " bytes instead of ");
    let (_folder, longer) = rewritten(|entries| entries[3].1.push(0));
    assert_pack_refused(&longer, 1, " bytes instead of ");
    let (_folder, missing) = rewritten(|entries| drop(entries.remove(3)));
    assert_pack_refused(&missing, 1, "in the place of the file");
    let (_folder, last) = rewritten(|entries| drop(entries.pop()));
    assert_pack_refused(&last, 1, " is missing; nothing was unpacked");
    let (_folder, more) = rewritten(|entries| {
        entries.push(Entry("runs/smoke/x/more".into(), b"more".to_vec(), tar::EntryType::Regular, ""));
    });
    assert_pack_refused(&more, 1, "it has files that its manifest.json does not list");
    let (_folder, unsealed) = rewritten(|entries| entries[0].1[40] ^= 1);
    assert_pack_refused(&unsealed, 1, "manifest.json: it has changed since it was written");
}

#[test]
fn runs_that_do_not_belong_in_their_folder_are_refused() {
    /// Moves or leaves out files of the empty scenario's run, in the manifest and in the archive.
    fn edited(edit: impl Fn(&str) -> Option<String>) -> (TempDir, PathBuf) {
        rewritten(|entries| {
            change_manifest(&mut entries[0], |manifest| {
                let files = manifest["files"].as_object_mut().unwrap();
                let renamed = std::mem::take(files).into_iter();
                files.extend(renamed.filter_map(|(path, file)| Some((edit(&path)?, file))));
                files.sort_keys();
            });
            let manifest = entries.remove(0);
            let renamed = std::mem::take(entries).into_iter();
            entries
                .extend(renamed.filter_map(|entry| Some(Entry(edit(&entry.0)?, entry.1, entry.2, entry.3))));
            entries.sort_by(|a, b| a.0.cmp(&b.0));
            entries.insert(0, manifest);
        })
    }
    let (_folder, moved) = edited(|path| Some(path.replace("runs/smoke/empty", "runs/smoke/full")));
    assert_pack_refused(&moved, 1, "it contains smoke/empty-z4-seed0-");
    let (_folder, partial) = edited(|path| (!path.ends_with("metrics.parquet")).then(|| path.to_owned()));
    assert_pack_refused(&partial, 1, "run.json lists other files; nothing was unpacked");
    let (_folder, unrecorded) = edited(|path| (!path.ends_with("run.json")).then(|| path.to_owned()));
    assert_pack_refused(&unrecorded, 1, "run.json is missing; nothing was unpacked");
}

/// A truncated pack is always refused. If a bit is flipped, it is refused, or the bit is in a part without meaning.
#[test]
fn a_damaged_pack_is_refused_or_gives_the_same_files() {
    let whole = fs::read(&*PACK).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let mut flipped = |_| {
        let (at, bit) = (random.random_range(0..whole.len()), random.random_range(0..8));
        let mut bytes = whole.clone();
        bytes[at] ^= 1 << bit;
        (bytes, format!("bit {bit} of byte {at}"))
    };
    let flips: Vec<_> = (0..60).map(&mut flipped).collect();
    let cuts = (0..60).map(|part| {
        let length = part * whole.len() / 60;
        (whole[..length].to_vec(), format!("cut off after {length} bytes"))
    });
    // The last bytes are zeros, which mark the end of the archive.
    let ends = [1, 512, 1024, 1536]
        .map(|lost| (whole[..whole.len() - lost].to_vec(), format!("cut off by {lost} bytes")));
    let folder = tempfile::tempdir().unwrap();
    let (path, results) = (folder.path().join("damaged.harness"), folder.path().join("results"));
    let mut refused = 0;
    for (bytes, what) in flips.into_iter().chain(cuts).chain(ends) {
        fs::write(&path, bytes).unwrap();
        match transfer::unpack(&Registry::new(&results), &path, &Silent) {
            Err(error) => {
                refused += 1;
                assert!(!error.to_string().contains('\n'), "{what}: {error}");
                assert!(!results.exists(), "{what}");
            }
            Ok(_) => {
                assert!(!what.starts_with("cut") && runs(&results) == runs(&RESULTS), "{what}");
                fs::remove_dir_all(&results).unwrap();
            }
        }
    }
    assert!(refused > 100, "{refused}");
}

#[test]
fn a_run_with_other_content_is_kept_and_nothing_is_unpacked() {
    let results = fresh("unpacked-differing");
    // The same runs, done here: their epochs have other times.
    succeed(&results, &["run", SMOKE]);
    fs::remove_dir_all(child(results.join("runs/smoke"), "cluttered")).unwrap();
    let before = files(&results);
    let answer = unpack(&results, &PACK);
    assert_refused(&answer, 1, " exists already with other content (epochs.parquet); nothing was unpacked.");
    assert!(files(&results) == before);
    fs::remove_dir_all(results.join("runs")).unwrap();
    let dataset = child(results.join("datasets"), "empty");
    fs::write(dataset.join("episode_00001.parquet"), "other").unwrap();
    let before = files(&results);
    assert_refused(
        &unpack(&results, &WHOLE),
        1,
        " exists already with other content (episode_00001.parquet)",
    );
    assert!(files(&results) == before);
}

#[test]
fn folders_in_which_a_process_works_are_left_to_it() {
    let results = fresh("unpacked-busy");
    let run = child(RESULTS.join("runs/smoke"), "empty");
    let run = results.join("runs/smoke").join(run.file_name().unwrap());
    let lock = FolderLock::attempt(&run).unwrap();
    let answer = unpack(&results, &PACK);
    assert_refused(&answer, 1, &format!("error: process {} on ", std::process::id()));
    assert!(answer.stderr.contains("; try again when it has ended"), "{}", answer.stderr);
    assert!(files(&results).is_empty());
    drop(lock);
    assert_eq!(unpack(&results, &PACK).code, 0);
    assert!(runs(&results) == runs(&RESULTS));
}

// --- disks and signals ---

#[test]
fn a_pack_larger_than_the_free_space_is_refused_unwritten() {
    let (_folder, huge) = with_manifest(|manifest| {
        let first = first(manifest);
        manifest["files"][first]["bytes"] = 4_000_000_000_000_000_000_u64.into();
    });
    assert_pack_refused(&huge, 1, "the files take 4000000 TB in ");
    let (_folder, most) = with_manifest(|manifest| {
        for file in manifest["files"].as_object_mut().unwrap().values_mut() {
            file["bytes"] = u64::MAX.into();
        }
    });
    assert_pack_refused(&most, 1, " are free there; make room, or choose a folder on another disk");
    let Some(disk) = Disk::new(64) else {
        println!("skipped: no small disk can be mounted here");
        return;
    };
    assert_refused(&unpack(disk.path(), &PACK), 1, ", and only 65.5 kB are free there");
    assert!(fs::read_dir(disk.path()).unwrap().next().is_none());
    let output = disk.path().join("it.harness");
    let arguments = ["pack", "smoke", "--output", output.to_str().unwrap()];
    assert_refused(&finish(&mut harness(&RESULTS, &arguments)), 1, ", and only 65.5 kB are free there");
    assert!(fs::read_dir(disk.path()).unwrap().next().is_none());
}

#[test]
fn a_disk_that_gets_full_leaves_the_results_as_they_were() {
    let Some(disk) = Disk::new(64_000) else {
        println!("skipped: no small disk can be mounted here");
        return;
    };
    let run = ["run", SMOKE, "scenarios=[empty]", "tasks=[prediction]", "training.epochs=1"];
    succeed(disk.path(), &run);
    // Files can't be made any more, though there is space.
    let entries = || 1 + files(disk.path()).len() * 2;
    disk.remount(&format!("nr_inodes={}", entries() + 8));
    let before = files(disk.path());
    assert_refused(&unpack(disk.path(), &WHOLE), 1, "No space left on device");
    assert!(files(disk.path()) == before);
    disk.remount("nr_inodes=1000");
    assert_eq!(unpack(disk.path(), &WHOLE).code, 0);
    let output = disk.path().join("new/it.harness");
    disk.remount("ro");
    let arguments = ["pack", "smoke", "--output", output.to_str().unwrap()];
    assert_refused(&finish(&mut harness(&RESULTS, &arguments)), 1, "Read-only file system");
    assert_refused(&unpack(disk.path(), &WHOLE), 1, "Read-only file system");
}

/// Runs a command under a limit of the size of the files that it writes, in kilobytes. The system kills it when it
/// writes a larger one.
fn killed_at(kilobytes: usize, results: &Path, arguments: &[&str]) {
    let limited = format!("ulimit -c 0; ulimit -f {kilobytes}; exec \"$@\"");
    let mut command = Command::new("bash");
    command
        .args(["-c", &limited, "bash", env!("CARGO_BIN_EXE_harness"), "--results"])
        .arg(results)
        .args(arguments);
    let output = command.output().unwrap();
    assert_eq!(output.status.signal(), Some(libc::SIGXFSZ), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn a_kill_leaves_the_results_as_they_were_and_a_retry_does_all() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("it.harness");
    let packing = ["pack", "smoke", "--datasets", "--output", output.to_str().unwrap()];
    killed_at(40, &RESULTS, &packing);
    assert!(!output.exists());
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "what it has written");
    // A process that is still writing has locked its file.
    let held = folder.path().join(format!("{UNFINISHED}held12"));
    let lock = fs::File::create(&held).unwrap();
    lock.lock().unwrap();
    succeed(&RESULTS, &packing);
    let mut left: Vec<PathBuf> =
        fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().path()).collect();
    left.sort();
    assert_eq!(left, [held, output.clone()]);
    assert!(fs::read(&output).unwrap() == fs::read(&*WHOLE).unwrap());

    let results = fresh("unpacked-killed");
    let is_left = |path: &PathBuf| path.to_string_lossy().starts_with(&format!("{UNFINISHED}unpack-"));
    // The episodes are larger, and the description of their dataset comes before them.
    killed_at(40, &results, &["unpack", output.to_str().unwrap()]);
    assert!(files(&results).keys().all(is_left));
    assert!(files(&results).len() > 1);
    assert_eq!(unpack(&results, &output).code, 0);
    assert!(files(&results) == files(&RESULTS));
}

#[test]
fn an_unpacking_killed_at_any_moment_shows_whole_runs_only() {
    let results = fresh("unpacked-killed-often");
    let mut random = ChaCha8Rng::seed_from_u64(4);
    let expected = files(&RESULTS);
    for _ in 0..15 {
        let mut command = Command::new(env!("CARGO_BIN_EXE_harness"));
        let mut child = command.arg("--results").arg(&results).arg("unpack").arg(&*WHOLE).spawn().unwrap();
        std::thread::sleep(Duration::from_millis(random.random_range(5..80)));
        let _ = child.kill();
        child.wait().unwrap();
        let mut found = files(&results);
        found.retain(|path, _| !path.to_string_lossy().starts_with(UNFINISHED));
        for (path, bytes) in &found {
            assert!(expected[path] == *bytes, "{}", path.display());
            // Whatever has appeared has all of its files.
            let folder = path.parent().unwrap();
            let all = expected.keys().filter(|path| path.parent() == Some(folder)).count();
            assert_eq!(
                found.keys().filter(|path| path.parent() == Some(folder)).count(),
                all,
                "{}",
                folder.display()
            );
        }
    }
    assert_eq!(unpack(&results, &WHOLE).code, 0);
    assert!(files(&results) == expected);
}
