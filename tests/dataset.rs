//! Datasets from real simulations: the same whatever the threads, whole or made again, and read as written.

use harness::dataset::{Dataset, DatasetError, Samples, Standard, collect};
use harness::files::UNFINISHED;
use harness::progress::{Progress, Silent};
use harness::simulation::{Episode, Scene, SimulationError, Simulator};
use harness::spec::{ARM_JOINTS, Action, FRAME_CHANNELS, FRAME_LEN, Modality, Scenario, Simulation, Split};
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::SystemTime;

/// Two seconds an episode, of which there are four.
fn short() -> Simulation {
    Simulation { episodes: 4, actuations_per_episode: 2, ..Simulation::default() }
}

fn scene(scenario: Scenario) -> Scene {
    Scene::load(scenario, None).unwrap()
}

/// A collected dataset in a folder of its own.
struct Collected {
    root: tempfile::TempDir,
    scene: Scene,
    dataset: Dataset,
}

impl Collected {
    fn new(scenario: Scenario, threads: usize) -> Self {
        let (root, scene) = (tempfile::tempdir().unwrap(), scene(scenario));
        let dataset = Dataset::new(root.path(), &scene, &short());
        assert_eq!(collect(&dataset, &scene, threads, &Silent).unwrap(), 4);
        Self { root, scene, dataset }
    }

    fn episode(&self, index: u32) -> PathBuf {
        self.dataset.folder().join(format!("episode_{index:05}.parquet"))
    }

    fn collect_again(&self) -> usize {
        collect(&self.dataset, &self.scene, 2, &Silent).unwrap()
    }
}

/// The content of every file in a folder, by name.
fn contents(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let files = std::fs::read_dir(folder).unwrap().map(|entry| {
        let path = entry.unwrap().path();
        (path.file_name().unwrap().to_string_lossy().into_owned(), std::fs::read(&path).unwrap())
    });
    files.collect()
}

fn modified(path: &Path) -> SystemTime {
    std::fs::metadata(path).unwrap().modified().unwrap()
}

#[test]
fn episodes_are_the_same_bytes_with_one_thread_and_with_two() {
    for &scenario in Scenario::ALL {
        let one = contents(Collected::new(scenario, 1).dataset.folder());
        let two = contents(Collected::new(scenario, 2).dataset.folder());
        assert_eq!(one.keys().collect::<Vec<_>>(), two.keys().collect::<Vec<_>>());
        assert_eq!(one.keys().filter(|name| name.ends_with(".parquet")).count(), 4);
        for (name, bytes) in &one {
            assert!(*bytes == two[name], "{scenario}: {name} differs");
        }
    }
}

#[test]
fn an_episode_comes_back_as_it_was_simulated() {
    let collected = Collected::new(Scenario::Cluttered, 2);
    let mut simulator = Simulator::new(&collected.scene, collected.dataset.spec()).unwrap();
    let simulated = simulator.run(2, &mut || ControlFlow::Continue(())).unwrap();
    // Where the boxes were and who drew the frames is not part of the table.
    let expected = Episode { boxes: Vec::new(), renderer: String::new(), ..simulated };
    assert!(collected.dataset.read(2, true).unwrap() == expected);
    let without_frames = Episode { vision: Vec::new(), ..expected.clone() };
    assert!(collected.dataset.read(2, false).unwrap() == without_frames);

    let samples = collected.dataset.load(true).unwrap();
    let (first, plane) = (samples.episodes()[2].start, FRAME_LEN / FRAME_CHANNELS);
    for (row, frame) in expected.vision.chunks(FRAME_LEN).enumerate() {
        // Written pixel by pixel, held channel by channel.
        let held = samples.frame_bytes(first + row);
        assert!(
            (0..FRAME_LEN).all(|at| held[at % FRAME_CHANNELS * plane + at / FRAME_CHANNELS] == frame[at])
        );
    }
}

#[test]
fn only_what_is_missing_is_collected() {
    let collected = Collected::new(Scenario::Empty, 2);
    let before = contents(collected.dataset.folder());
    let times: Vec<SystemTime> = (0..4).map(|index| modified(&collected.episode(index))).collect();
    assert_eq!(collected.collect_again(), 0);
    std::fs::remove_file(collected.episode(1)).unwrap();
    assert_eq!(collected.dataset.missing(), [1]);
    assert_eq!(collected.collect_again(), 1);
    assert!(contents(collected.dataset.folder()) == before);
    for index in [0, 2, 3] {
        assert_eq!(
            modified(&collected.episode(index)),
            times[index as usize],
            "episode {index} was left alone"
        );
    }
    let longer = Simulation { episodes: 6, ..short() };
    let longer = Dataset::new(collected.root.path(), &collected.scene, &longer);
    assert_eq!(longer.folder(), collected.dataset.folder(), "a longer dataset extends a shorter one");
    assert_eq!(longer.missing(), [4, 5]);
}

#[test]
fn what_decides_the_content_decides_the_folder() {
    let (root, scene) = (Path::new("datasets"), scene(Scenario::Empty));
    let name = |spec: Simulation| Dataset::new(root, &scene, &spec).name().to_owned();
    let others = [
        Simulation { seed: 1, ..short() },
        Simulation { actuations_per_episode: 3, ..short() },
        Simulation { extension_range_m: [0.0, 1.0], ..short() },
    ];
    for other in others {
        assert_ne!(name(other.clone()), name(short()), "{other:?}");
    }
    let edited = scene.xml().replace("damping=\"3\"", "damping=\"4\"");
    assert_ne!(edited, scene.xml());
    let edited = Scene::from_xml(Scenario::Empty, &edited, "edited.xml".into()).unwrap();
    assert_ne!(Dataset::new(root, &edited, &short()).name(), name(short()));
}

#[test]
fn a_truncated_episode_is_noticed_and_only_that_one_is_made_again() {
    let collected = Collected::new(Scenario::Empty, 2);
    let before = contents(collected.dataset.folder());
    let untouched = modified(&collected.episode(0));
    for keep in [0, 3, 1000, std::fs::metadata(collected.episode(3)).unwrap().len() as usize - 1] {
        let whole = std::fs::read(collected.episode(3)).unwrap();
        std::fs::write(collected.episode(3), &whole[..keep]).unwrap();
        assert_eq!(collected.dataset.missing(), [3], "after {keep} bytes");
        assert!(collected.dataset.load(true).is_err());
        assert_eq!(collected.collect_again(), 1);
        assert!(contents(collected.dataset.folder()) == before);
    }
    assert_eq!(modified(&collected.episode(0)), untouched);
}

#[test]
fn a_flipped_bit_never_reaches_the_samples_and_is_mended() {
    let collected = Collected::new(Scenario::Empty, 2);
    let before = contents(collected.dataset.folder());
    let whole = std::fs::read(collected.episode(1)).unwrap();
    let untouched = modified(&collected.episode(0));
    for part in 0..10 {
        let mut flipped = whole.clone();
        flipped[whole.len() * part / 10] ^= 1 << (part % 8);
        std::fs::write(collected.episode(1), flipped).unwrap();
        let error = collected.dataset.read(1, true).unwrap_err();
        assert!(matches!(error, DatasetError::Damaged { .. }), "part {part}: {error}");
        assert!(error.to_string().contains("episode_00001.parquet is damaged"), "{error}");
        assert_eq!(collected.dataset.missing(), [1]);
        assert_eq!(collected.collect_again(), 1);
        assert!(contents(collected.dataset.folder()) == before);
    }
    assert_eq!(modified(&collected.episode(0)), untouched);
}

#[test]
fn an_episode_of_another_dataset_is_not_taken_for_ones_own() {
    let (ours, theirs) = (Collected::new(Scenario::Empty, 2), Collected::new(Scenario::Cluttered, 2));
    std::fs::copy(theirs.episode(2), ours.episode(2)).unwrap();
    assert_eq!(ours.dataset.missing(), [2]);
}

#[test]
fn a_simulation_that_diverges_is_an_error_and_leaves_no_episode() {
    let stiff = scene(Scenario::Empty).xml().replace("timestep=\"0.001\"", "timestep=\"0.1\"");
    let models = tempfile::tempdir().unwrap();
    std::fs::write(models.path().join("empty.xml"), stiff).unwrap();
    let scene = Scene::load(Scenario::Empty, Some(models.path())).unwrap();
    let root = tempfile::tempdir().unwrap();
    let dataset = Dataset::new(root.path(), &scene, &short());
    let error = collect(&dataset, &scene, 2, &Silent).unwrap_err();
    assert!(matches!(error, DatasetError::Simulation(SimulationError::Diverged { .. })), "{error}");
    assert!(error.to_string().contains("diverged"), "{error}");
    let lock = format!("{UNFINISHED}lock");
    assert_eq!(contents(dataset.folder()).into_keys().collect::<Vec<_>>(), [&lock, "dataset.json"]);
    assert_eq!(dataset.missing(), [0, 1, 2, 3]);
}

/// Cancels after so many samples.
struct Impatient(AtomicU64);

impl Progress for Impatient {
    fn begin(&self, _: &str, _: u64, _: &str) {}
    fn advance(&self, steps: u64) {
        self.0.fetch_sub(steps, Ordering::Relaxed);
    }
    fn note(&self, _: &str) {}
    fn say(&self, _: &str) {}
    fn end(&self) {}
    fn cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed) == 0
    }
}

#[test]
fn a_cancelled_collection_keeps_whole_episodes_and_goes_on_from_them() {
    let (root, scene) = (tempfile::tempdir().unwrap(), scene(Scenario::Empty));
    let dataset = Dataset::new(root.path(), &scene, &short());
    // In the middle of the second episode.
    let error = collect(&dataset, &scene, 1, &Impatient(AtomicU64::new(30))).unwrap_err();
    assert!(matches!(error, DatasetError::Simulation(SimulationError::Cancelled { episode: 1 })), "{error}");
    assert_eq!(dataset.missing(), [1, 2, 3]);
    assert_eq!(collect(&dataset, &scene, 1, &Silent).unwrap(), 3);
}

#[test]
fn two_at_once_share_the_work() {
    let (root, scene) = (tempfile::tempdir().unwrap(), scene(Scenario::Empty));
    let dataset = Dataset::new(root.path(), &scene, &short());
    let made: usize = std::thread::scope(|scope| {
        let both = [(); 2].map(|()| scope.spawn(|| collect(&dataset, &scene, 1, &Silent).unwrap()));
        both.into_iter().map(|one| one.join().unwrap()).sum()
    });
    assert_eq!(made, 4, "whoever comes second waits and finds everything made");
    assert!(dataset.missing().is_empty());
}

/// The largest difference between two arrays.
fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn standardised_values_restore_to_what_was_recorded() {
    let samples: Arc<Samples> = Arc::new(Collected::new(Scenario::Cluttered, 2).dataset.load(true).unwrap());
    let at = samples.partition(&Split::default()).unwrap().training;
    let standard = Standard::fit(&samples, &at, Modality::ALL, Action::Increment);
    for modality in Modality::ALL.iter().copied() {
        let scale = &standard.scales[&modality];
        let (mut values, expected, unit) = if modality.is_frame() {
            let frames = standard.frames(&samples, &at, &[modality]).unwrap();
            let mut values = vec![0.0; at.len() * FRAME_LEN];
            let each = values.chunks_exact_mut(FRAME_LEN).enumerate();
            each.for_each(|(index, frame)| frames.write(index, frame));
            (values, harness::experiment::physical(&samples, modality, &at), 1.0)
        } else {
            let table = standard.vectors(&samples, &at, &[modality]).unwrap().unwrap();
            let expected: Vec<f32> =
                at.iter().flat_map(|sample| samples.vector(modality, *sample).iter().copied()).collect();
            let largest = expected.iter().fold(1.0, |largest: f32, value| largest.max(value.abs()));
            (table.flatten_all().unwrap().to_vec1().unwrap(), expected, largest)
        };
        let spread = values.iter().map(|value| value * value).sum::<f32>() / values.len() as f32;
        assert!(spread < 1.01, "{modality:?}: the mean square is {spread}");
        assert!(largest_difference(&values, &expected) > 0.01, "{modality:?} is standardised at all");
        scale.restore(&mut values);
        let error = largest_difference(&values, &expected);
        assert!(error < 1e-5 * unit, "{modality:?} is off by {error}");
    }
    let mut actions =
        standard.actions(&samples, &at, Action::Increment).unwrap().flatten_all().unwrap().to_vec1().unwrap();
    standard.action.restore(&mut actions);
    let expected: Vec<f32> =
        at.iter().flat_map(|sample| samples.action(Action::Increment, *sample)).collect();
    assert_eq!(expected.len(), at.len() * ARM_JOINTS);
    assert!(largest_difference(&actions, &expected) < 1e-5);
}

/// The Python package reads and writes episodes' files by this list.
#[test]
fn the_python_packages_columns_are_those_of_the_files() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("python/harness/columns.json");
    let checked_in: serde_json::Value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    let columns = [harness::schema::sample_columns(), vec![harness::schema::frame_column()]].concat();
    let expected = serde_json::to_value(&columns).unwrap();
    assert!(checked_in == expected, "python/harness/columns.json must hold {expected}");
}
