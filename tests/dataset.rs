//! Datasets of real simulations: they do not depend on threads or interruptions, and are read as they were written.

use finger::{ARM_JOINTS, FRAME_LEN, JOINTS};
use harness_experiment::ExperimentError;
use harness_experiment::collection::{collect, dataset_of};
use harness_ops::frames::{Frames, SampleFrames};
use harness_registry::dataset::{AnyDataset, CompiledModel, Dataset, DatasetError};
use harness_samples::{FramePlace, Normalizers, Partition, Recording, Sample, Samples, ends, sequences};
use harness_shared::files::UNFINISHED;
use harness_shared::progress::{Progress, Silent};
use harness_simulation::{Episode, EpisodePlan, Scene, SimulationError, Simulator};
use harness_spec::{
    Action, Division, IMAGE_CHANNELS, Layout, MAX_SEED, Modality, Scale, Scaling, Scalings, Scenario,
    Setting, Simulation, Split, Window, World,
};
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Barrier};
use std::time::{Duration, SystemTime};

#[path = "common/finger.rs"]
mod finger;

/// Path of the repository.
const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");

/// Four episodes of two seconds each.
fn short() -> Simulation {
    Simulation { episodes: 4, actuations_per_episode: 2, ..Simulation::default() }
}

fn scene(scenario: Scenario) -> Scene {
    Scene::paper(scenario).unwrap()
}

/// A collected dataset in a temporary folder.
struct Collected {
    root: tempfile::TempDir,
    scene: Scene,
    dataset: Dataset,
}

impl Collected {
    fn new(scenario: Scenario, threads: usize) -> Self {
        let (root, scene) = (tempfile::tempdir().unwrap(), scene(scenario));
        let dataset = dataset_of(root.path(), &scene, &short());
        assert_eq!(collect(&dataset, &scene, threads, &Silent).unwrap(), 4);
        Self { root, scene, dataset }
    }

    fn episode(&self, index: u32) -> PathBuf {
        self.dataset.folder().join(format!("episode_{index:05}.parquet"))
    }

    fn load(&self, frames: FramePlace) -> Result<Samples, DatasetError> {
        AnyDataset::from(self.dataset.clone()).load(frames, &Silent)
    }

    fn collect_again(&self) -> usize {
        collect(&self.dataset, &self.scene, 2, &Silent).unwrap()
    }
}

/// The contents of the files in a folder, by name.
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
    for scenario in Scenario::PAPER {
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
fn episodes_that_lack_a_column_are_collected_again() {
    let collected = Collected::new(Scenario::CLUTTERED, 2);
    let lacking = |modality: &str| {
        let mut layout = Layout::clone(collected.scene.layout());
        layout.modalities.retain(|definition| definition.name.name() != modality);
        Arc::new(layout)
    };
    let now = collected.dataset.read(1, true).unwrap();
    // The dataset of an earlier version, which did not record the mean forces.
    let layout = lacking("contact_force_mean");
    let model = CompiledModel {
        course_sha256: None,
        rule: collected.scene.rule(),
        layout: &layout,
        sha256: collected.scene.model_sha256(),
        mujoco_version: harness_simulation::mujoco_version(),
    };
    let earlier = Dataset::new(collected.root.path(), collected.scene.world(), model, &short());
    assert_eq!(earlier.name(), collected.dataset.name());
    earlier.describe(|| None).unwrap();
    let mut episode = Episode::new(layout.clone(), 1, now.samples);
    for definition in &layout.modalities {
        let place = layout.position(definition.name).unwrap();
        episode.vectors[place] = now.vector(definition.name).to_vec();
        episode.images[place] = now.image(definition.name).to_vec();
    }
    earlier.save(&episode).unwrap();
    assert_eq!(collected.dataset.missing(), [1]);
    assert_eq!(collected.collect_again(), 1);
    assert!(collected.dataset.read(1, true).unwrap() == now);
}

#[test]
fn factors_are_the_same_bytes_for_any_threads_and_interruptions() {
    let scene = scene(Scenario::CLUTTERED);
    let on = |names: &[&str]| Simulation {
        factors: names.iter().map(|name| (*name).to_owned()).collect(),
        ..short()
    };
    let collected = |threads: usize| {
        let root = tempfile::tempdir().unwrap();
        let dataset = dataset_of(root.path(), &scene, &on(&["finger_stiffness", "box_mass"]));
        if threads == 1 {
            collect(&dataset, &scene, 1, &Impatient(AtomicU64::new(30))).unwrap_err();
        }
        collect(&dataset, &scene, threads, &Silent).unwrap();
        (contents(dataset.folder()), dataset, root)
    };
    let ((one, dataset, _root), (two, ..)) = (collected(1), collected(2));
    assert_eq!(one.len(), 7, "four episodes, a description, a model and a lock");
    for (name, bytes) in &one {
        assert!(*bytes == two[name], "{name} differs");
    }
    let stiffness = |index: u32| {
        let episode = dataset.read(index, false).unwrap();
        let elements = episode.layout[Modality::FACTORS].elements();
        assert_eq!(elements[0].name, "finger_stiffness");
        assert_eq!((elements.len(), elements[8].name.as_str()), (9, "box_mass_7"));
        episode.vector(Modality::FACTORS)[0]
    };
    assert!((0.5..=2.0).contains(&stiffness(0)) && stiffness(0) != stiffness(1));

    // The names and the distributions of the factors that are on are part of the dataset's name, and no others.
    let name = |scene: &Scene, spec: &Simulation| dataset_of(Path::new("d"), scene, spec).name().to_owned();
    let edited = include_str!("../models/cluttered.yaml").replacen("[0.5, 2]", "[0.5, 3]", 1);
    let edited = World::parse("edited.yaml", None, "cluttered", &edited).unwrap();
    let edited = Scene::from_xml(edited.into(), scene.xml(), "cluttered.xml".into()).unwrap();
    for (names, is_same) in [(&["finger_stiffness"][..], false), (&["box_mass"], true), (&[], true)] {
        assert_eq!(name(&scene, &on(names)) == name(&edited, &on(names)), is_same, "{names:?}");
        assert!(names.is_empty() || name(&scene, &on(names)) != name(&scene, &on(&[])));
    }
}

#[test]
fn an_episode_comes_back_as_it_was_simulated() {
    let collected = Collected::new(Scenario::CLUTTERED, 2);
    let mut simulator = Simulator::new(&collected.scene, collected.dataset.spec()).unwrap();
    let simulated = simulator.run(2, &mut || ControlFlow::Continue(())).unwrap();
    // The table does not contain the places of the boxes and the name of the renderer.
    let expected = Episode { boxes: Vec::new(), renderer: String::new(), ..simulated };
    assert!(collected.dataset.read(2, true).unwrap() == expected);
    let without_frames = Episode { images: vec![Vec::new(); expected.images.len()], ..expected.clone() };
    assert!(collected.dataset.read(2, false).unwrap() == without_frames);

    let samples = collected.load(FramePlace::Memory).unwrap();
    let (first, plane) = (samples.episodes()[2].start, FRAME_LEN / IMAGE_CHANNELS);
    for (row, frame) in expected.image(Modality::VISION).chunks(FRAME_LEN).enumerate() {
        // Frames are stored pixel by pixel, and kept in memory channel by channel.
        let held = samples.frame_bytes(Modality::VISION, Sample::at(first + row));
        assert!(
            (0..FRAME_LEN).all(|at| held[at % IMAGE_CHANNELS * plane + at / IMAGE_CHANNELS] == frame[at])
        );
    }
}

#[test]
fn only_what_is_missing_is_collected() {
    let collected = Collected::new(Scenario::EMPTY, 2);
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
    let longer = dataset_of(collected.root.path(), &collected.scene, &longer);
    assert_eq!(longer.folder(), collected.dataset.folder(), "a longer dataset extends a shorter one");
    assert_eq!(longer.missing(), [4, 5]);
}

#[test]
fn what_decides_the_content_decides_the_folder() {
    let (root, scene) = (Path::new("datasets"), scene(Scenario::EMPTY));
    let name = |spec: Simulation| dataset_of(root, &scene, &spec).name().to_owned();
    let others = [
        Simulation { seed: 1, ..short() },
        Simulation { actuations_per_episode: 3, ..short() },
        short().with("extension_range_m", Setting::Range([0.0, 1.0])),
    ];
    for other in others {
        assert_ne!(name(other.clone()), name(short()), "{other:?}");
    }
    let edited = scene.xml().replace("damping=\"3\"", "damping=\"4\"");
    assert_ne!(edited, scene.xml());
    let edited = Scene::from_xml(World::paper(Scenario::EMPTY), &edited, "edited.xml".into()).unwrap();
    assert_ne!(dataset_of(root, &edited, &short()).name(), name(short()));
}

#[test]
fn a_truncated_episode_is_noticed_and_alone_made_again() {
    let collected = Collected::new(Scenario::EMPTY, 2);
    let before = contents(collected.dataset.folder());
    let untouched = modified(&collected.episode(0));
    for keep in [0, 3, 1000, std::fs::metadata(collected.episode(3)).unwrap().len() as usize - 1] {
        let whole = std::fs::read(collected.episode(3)).unwrap();
        std::fs::write(collected.episode(3), &whole[..keep]).unwrap();
        assert_eq!(collected.dataset.missing(), [3], "after {keep} bytes");
        assert!(collected.load(FramePlace::Memory).is_err());
        assert_eq!(collected.collect_again(), 1);
        assert!(contents(collected.dataset.folder()) == before);
    }
    assert_eq!(modified(&collected.episode(0)), untouched);
}

#[test]
fn a_flipped_bit_never_reaches_the_samples_and_is_mended() {
    let collected = Collected::new(Scenario::EMPTY, 2);
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
    let (ours, theirs) = (Collected::new(Scenario::EMPTY, 2), Collected::new(Scenario::CLUTTERED, 2));
    std::fs::copy(theirs.episode(2), ours.episode(2)).unwrap();
    assert_eq!(ours.dataset.missing(), [2]);
}

#[test]
fn a_simulation_that_diverges_is_an_error_and_leaves_no_episode() {
    let heavy = scene(Scenario::EMPTY)
        .xml()
        .replace("timestep=\"0.001\"", "timestep=\"0.001\" gravity=\"0 0 -1e30\"");
    let world = World::parse("heavy.yaml", None, "empty", include_str!("../models/empty.yaml")).unwrap();
    let scene = Scene::from_xml(world.into(), &heavy, "heavy.xml".into()).unwrap();
    let root = tempfile::tempdir().unwrap();
    let dataset = dataset_of(root.path(), &scene, &short());
    let error = collect(&dataset, &scene, 2, &Silent).unwrap_err();
    assert!(matches!(error, ExperimentError::Simulation(SimulationError::Diverged { .. })), "{error}");
    assert!(error.to_string().contains("diverged"), "{error}");
    let lock = format!("{UNFINISHED}lock");
    assert_eq!(
        contents(dataset.folder()).into_keys().collect::<Vec<_>>(),
        [&lock, "dataset.json", "model.xml"]
    );
    assert_eq!(dataset.missing(), [0, 1, 2, 3]);
}

/// Cancels after this many samples.
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
fn a_cancelled_collection_goes_on_from_the_whole_episodes() {
    let (root, scene) = (tempfile::tempdir().unwrap(), scene(Scenario::EMPTY));
    let dataset = dataset_of(root.path(), &scene, &short());
    // This is in the middle of the second episode.
    let error = collect(&dataset, &scene, 1, &Impatient(AtomicU64::new(30))).unwrap_err();
    assert!(
        matches!(error, ExperimentError::Simulation(SimulationError::Cancelled { episode: 1 })),
        "{error}"
    );
    assert_eq!(dataset.missing(), [1, 2, 3]);
    assert_eq!(collect(&dataset, &scene, 1, &Silent).unwrap(), 3);
}

/// Leaves a thread-local value that takes a while to free on each of two calling threads, like an OpenGL driver.
struct LeavesSomething {
    freed: Arc<AtomicU64>,
    /// The first thread that comes waits for the other one. Otherwise it could do all the work alone.
    both: Barrier,
}

thread_local! {
    static LEFT: RefCell<Option<FreedSlowly>> = const { RefCell::new(None) };
}

struct FreedSlowly(Arc<AtomicU64>);

impl Drop for FreedSlowly {
    fn drop(&mut self) {
        std::thread::sleep(Duration::from_millis(200));
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

impl Progress for LeavesSomething {
    fn begin(&self, _: &str, _: u64, _: &str) {}
    fn advance(&self, _: u64) {
        LEFT.with_borrow_mut(|left| {
            left.get_or_insert_with(|| {
                self.both.wait();
                FreedSlowly(self.freed.clone())
            });
        });
    }
    fn note(&self, _: &str) {}
    fn say(&self, _: &str) {}
    fn end(&self) {}
}

#[test]
fn collecting_ends_after_its_threads_have_freed_everything() {
    let (root, scene) = (tempfile::tempdir().unwrap(), scene(Scenario::EMPTY));
    let dataset = dataset_of(root.path(), &scene, &short());
    let progress = LeavesSomething { freed: Arc::default(), both: Barrier::new(2) };
    collect(&dataset, &scene, 2, &progress).unwrap();
    assert_eq!(progress.freed.load(Ordering::Relaxed), 2);
}

#[test]
fn two_at_once_share_the_work() {
    let (root, scene) = (tempfile::tempdir().unwrap(), scene(Scenario::EMPTY));
    let dataset = dataset_of(root.path(), &scene, &short());
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
fn normalized_values_restore_to_what_was_recorded() {
    let samples: Arc<Samples> =
        Arc::new(Collected::new(Scenario::CLUTTERED, 2).load(FramePlace::Memory).unwrap());
    let at = samples.partition(&Split::default(), &Window::TRANSITION).unwrap().training;
    let scalings = Modality::BUILT_IN
        .iter()
        .map(|&modality| (modality, World::paper(Scenario::EMPTY).scaling(modality, &[]).unwrap()))
        .collect();
    let normalizers = Arc::new(Normalizers::fit(&samples, &at, &scalings, Action::Increment));
    for modality in Modality::BUILT_IN.iter().copied() {
        let scale = &normalizers.modalities[&modality];
        let (mut values, expected, unit) = if samples.layout()[modality].is_image() {
            let frames = SampleFrames::new(&samples, &normalizers, &at, modality, None).unwrap();
            let mut values = vec![0.0; at.len() * FRAME_LEN];
            let each = values.chunks_exact_mut(FRAME_LEN).enumerate();
            each.for_each(|(index, frame)| frames.write(index, frame));
            (values, harness_samples::physical(&samples, modality, &at), 1.0)
        } else {
            let values = normalizers.vectors(&samples, &at, &[modality]);
            let expected: Vec<f32> =
                at.iter().flat_map(|sample| samples.vector(modality, *sample).iter().copied()).collect();
            let largest = expected.iter().fold(1.0, |largest: f32, value| largest.max(value.abs()));
            (values, expected, largest)
        };
        let spread = values.iter().map(|value| value * value).sum::<f32>() / values.len() as f32;
        assert!(spread < 1.01, "{modality:?}: the mean square is {spread}");
        assert!(largest_difference(&values, &expected) > 0.01, "{modality:?} is normalized at all");
        scale.denormalize(&mut values);
        let error = largest_difference(&values, &expected);
        assert!(error < 1e-5 * unit, "{modality:?} is off by {error}");
    }
    let mut actions = normalizers.actions(&samples, &at, Action::Increment);
    normalizers.action.denormalize(&mut actions);
    let expected: Vec<f32> =
        at.iter().flat_map(|sample| samples.action(Action::Increment, *sample).collect::<Vec<_>>()).collect();
    assert_eq!(expected.len(), at.len() * ARM_JOINTS);
    assert!(largest_difference(&actions, &expected) < 1e-5);
}

#[test]
fn frames_on_disk_are_those_in_memory_and_leave_no_file() {
    let collected = Collected::new(Scenario::CLUTTERED, 2);
    let before = contents(collected.dataset.folder());
    let memory = collected.load(FramePlace::Memory).unwrap();
    let disk = collected.load(FramePlace::Disk).unwrap();
    assert_eq!(memory.image(Modality::VISION).len(), memory.len() * FRAME_LEN);
    assert!(disk.image(Modality::VISION) == memory.image(Modality::VISION));
    // This is often enough that pages are released in between.
    let at = at((0..disk.len()).rev());
    for _ in 0..400 {
        disk.prefetch(Modality::VISION, &at);
    }
    assert!(
        at.iter().all(|&sample| disk.frame_bytes(Modality::VISION, sample)
            == memory.frame_bytes(Modality::VISION, sample))
    );
    assert!(
        disk.previous_frame_bytes(Modality::VISION, Sample::at(7))
            == memory.frame_bytes(Modality::VISION, Sample::at(6))
    );
    assert_eq!(disk.vectors(Modality::CONTACT_FORCE), memory.vectors(Modality::CONTACT_FORCE));
    assert!(contents(collected.dataset.folder()) == before, "the file has no name, even while it is used");
    assert!(!collected.load(FramePlace::Nowhere).unwrap().has_frames());
}

#[test]
fn frames_that_cannot_be_written_are_an_error_with_the_folder() {
    let recording = Recording { sample_rate_hz: 10.0, seed: 0 };
    let file = tempfile::NamedTempFile::new().unwrap();
    let error =
        Samples::new(recording, Layout::finger(), 1, FramePlace::Disk, file.path()).unwrap_err().to_string();
    assert!(error.contains(&format!("can't be kept in {}", file.path().display())), "{error}");
}

#[test]
fn frames_stay_in_memory_up_to_a_limit() {
    let place = |samples, limit| FramePlace::for_samples(&Layout::finger(), samples, limit);
    assert_eq!(place(1000, Some(12_288_000)), FramePlace::Memory);
    assert_eq!(place(1000, Some(12_287_999)), FramePlace::Disk);
    assert_eq!(place(1000, None), FramePlace::Memory);
    assert_eq!(place(100_000_000, None), FramePlace::Disk, "no machine has 8 times 1.2 TB");
}

/// Episodes of these numbers of samples at 10 Hz. In sample s of the dataset the force on each link is s newtons, and
/// on the last link 3 s newtons.
fn ramps(seed: u64, lengths: &[usize]) -> Samples {
    ramps_in(Layout::finger(), seed, lengths)
}

fn ramps_in(layout: Arc<Layout>, seed: u64, lengths: &[usize]) -> Samples {
    let recording = Recording { sample_rate_hz: 10.0, seed };
    let mut all = Samples::new(
        recording,
        layout.clone(),
        lengths.iter().sum(),
        FramePlace::Memory,
        Path::new("nowhere"),
    )
    .unwrap();
    for (index, &samples) in (0..).zip(lengths) {
        let first = all.len();
        let force = |at: usize| {
            let sample = (first + at / JOINTS) as f32;
            if at % JOINTS == JOINTS - 1 { 3.0 * sample } else { sample }
        };
        let forces: Vec<f32> = (0..samples * JOINTS).map(force).collect();
        let vision = (0..samples * FRAME_LEN).map(|at| (first + at / FRAME_LEN + at) as u8);
        let mut episode = Episode::new(layout.clone(), index, samples);
        for (place, definition) in layout.modalities.iter().enumerate() {
            if definition.width() == JOINTS {
                episode.vectors[place] = forces.clone();
            } else if definition.width() == ARM_JOINTS {
                episode.vectors[place] = vec![0.0; samples * ARM_JOINTS];
            } else if definition.difference_of.is_none() {
                episode.images[place] = vision.clone().collect();
            }
        }
        all.push(&episode).unwrap();
    }
    all
}

/// The samples at these positions.
fn at(positions: impl IntoIterator<Item = usize>) -> Vec<Sample> {
    positions.into_iter().map(Sample::at).collect()
}

fn split(by: Division) -> Split {
    Split { by, ..Split::default() }
}

#[test]
fn a_split_by_time_trains_on_each_episodes_start_before_a_gap() {
    // Of 200 samples at 10 Hz, 20 are for validation and 20 for test, and each gap has 50 by default.
    let samples = ramps(0, &[200, 200]);
    let Partition { training, validation, test } =
        samples.partition(&split(Division::Time), &Window::TRANSITION).unwrap();
    // A transition's next sample belongs to the same part, so a part has one transition less than samples.
    let expected = |part: std::ops::Range<usize>| at(part.clone().chain(part.start + 200..part.end + 200));
    assert_eq!(training, expected(0..59));
    assert_eq!(validation, expected(110..129));
    assert_eq!(test, expected(180..199));
    let narrow = Split { gap_seconds: Some(0.25), test: 0.2.into(), ..split(Division::Time) };
    let Partition { training, validation, test } = samples.partition(&narrow, &Window::TRANSITION).unwrap();
    assert_eq!((training.len(), validation[0], test[0]), (2 * 133, Sample::at(137), Sample::at(160)));
    // An episode that is too short for the gaps is left out. If all are, there is nothing to train on.
    let partition =
        |lengths: &[usize]| ramps(0, lengths).partition(&split(Division::Time), &Window::TRANSITION);
    assert_eq!(partition(&[200, 100]), partition(&[200]));
    assert_eq!(partition(&[100, 100]), None);
}

#[test]
fn one_continuous_run_is_split_by_time_or_sample_not_by_episode() {
    let samples = ramps(0, &[1000]);
    assert_eq!(samples.partition(&split(Division::Episode), &Window::TRANSITION), None);
    let Partition { training, validation, test } =
        samples.partition(&split(Division::Time), &Window::TRANSITION).unwrap();
    assert_eq!((training, validation, test), (at(0..699), at(750..849), at(900..999)));
    let Partition { training, validation, test } =
        samples.partition(&split(Division::Sample), &Window::TRANSITION).unwrap();
    assert_eq!([training.len(), validation.len(), test.len()], [799, 100, 100]);
}

#[test]
fn a_split_by_sample_draws_all_once_by_the_datasets_seed_alone() {
    let by_sample = split(Division::Sample);
    let drawn = |seed| ramps(seed, &[300, 200]).partition(&by_sample, &Window::TRANSITION).unwrap();
    let one = drawn(1);
    assert_eq!(one, drawn(1));
    assert_ne!(one.test, drawn(2).test);
    let Partition { training, validation, test } = one;
    assert_eq!([training.len(), validation.len(), test.len()], [398, 50, 50]);
    let mut all = [training.clone(), validation, test.clone()].concat();
    all.sort_unstable();
    assert_eq!(all, at((0..299).chain(300..499)));
    // The documentation warns of this: nearly every test sample has a neighbor in the training set.
    let neighbors =
        test.iter().filter(|at| training.iter().any(|other| other.index().abs_diff(at.index()) == 1));
    assert!(neighbors.count() > 40);
}

#[test]
fn a_window_never_leaves_its_episode_or_its_part() {
    let samples = ramps(0, &[200, 300]);
    let window = Window { context: 4, horizon: 3, ..Window::TRANSITION };
    let episode_of = |sample: Sample| samples.place(sample).0;
    let parts = |by| {
        let Partition { training, validation, test } = samples.partition(&split(by), &window).unwrap();
        [training, validation, test]
    };
    // An episode has six windows less than samples, and three more with a context of one sample.
    assert_eq!(parts(Division::Sample).each_ref().map(Vec::len), [488 - 98, 49, 49]);
    let by_time = parts(Division::Time);
    assert_eq!(by_time.each_ref().map(Vec::len), [60 + 140 - 6, 20 + 30 - 6, 20 + 30 - 12]);
    assert_eq!(
        (by_time[0][0], by_time[1][0], by_time[2][0]),
        (Sample::at(0), Sample::at(110), Sample::at(183))
    );
    for present in parts(Division::Sample).iter().flatten().chain(&by_time[2]) {
        assert_eq!(episode_of(present.before(3)), episode_of(present.after(3)));
    }
    // A sequence for training has a whole context, and neither it nor what it predicts leaves its part.
    let [training, validation, test] = by_time;
    let whole = |part: &[Sample]| sequences(part, 4, |most| most);
    let used = |part: &[Sample]| -> BTreeSet<usize> {
        part.iter().flat_map(|present| present.index() - 3..=present.index() + 3).collect()
    };
    let by_time = [whole(&training), whole(&validation), test];
    let [training, validation, test] = by_time.each_ref().map(|part| used(part));
    assert!(
        training.is_disjoint(&validation) && validation.is_disjoint(&test) && training.is_disjoint(&test)
    );
    // No episode has a window that is longer than it.
    let long = Window { context: 150, horizon: 100, ..Window::TRANSITION };
    let Partition { training, validation, test } =
        ramps(0, &[200, 300, 300, 300]).partition(&split(Division::Episode), &long).unwrap();
    assert_eq!([training.len(), validation.len(), test.len()], [100 + 200, 200, 51]);
    assert_eq!(samples.partition(&split(Division::Time), &long), None);
}

#[test]
fn sequences_cover_their_episodes_without_overlap() {
    let samples = ramps(0, &[40, 23, 7]);
    let all = samples.windows(&Window::TRANSITION);
    for length in [1, 4, 7] {
        let windows = samples.windows(&Window { context: length, ..Window::TRANSITION });
        for left_out in [|_: usize| 0, |most: usize| most] {
            let taken = sequences(&all, length, left_out);
            assert!(taken.iter().all(|last| windows.contains(last)));
            let seen: Vec<usize> = taken.iter().flat_map(|at| at.index() + 1 - length..=at.index()).collect();
            assert_eq!(seen.iter().collect::<BTreeSet<_>>().len(), seen.len(), "no sample is seen twice");
            // The last sample of an episode is only predicted.
            let covered: usize = [39, 22, 6].map(|transitions| transitions / length * length).iter().sum();
            assert_eq!(seen.len(), covered, "{length}");
        }
        // All sequences, with those that overlap, end where the windows with this context do.
        assert_eq!(ends(&all, length), windows);
    }
}

#[test]
fn the_objects_of_a_set_share_means_and_deviations() {
    let mut layout = Layout::clone(&Layout::finger());
    for force in [Modality::CONTACT_FORCE, Modality::CONTACT_FORCE_MEAN] {
        let place = layout.position(force).unwrap();
        layout.modalities[place].objects = Some(10);
    }
    let samples = ramps_in(Arc::new(layout), 0, &[12]);
    let scaling = |scale| Scaling { scale, minimum: None };
    let scalings = Scalings::from([
        (Modality::CONTACT_FORCE, scaling(Scale::Shared)),
        (Modality::CONTACT_FORCE_MEAN, scaling(Scale::PerElement)),
    ]);
    let normalizers = Normalizers::fit(&samples, &at(0..11), &scalings, Action::Increment);
    // The first value of each object goes from 0 to 10: mean 5, variance 10. So does the second value of nine objects,
    // and that of the tenth is three times as large: mean (9 * 5 + 15) / 10 = 6, variance 63 - 36 = 27.
    let own = &normalizers.modalities[&Modality::CONTACT_FORCE_MEAN];
    let shared = &normalizers.modalities[&Modality::CONTACT_FORCE];
    for object in 0..10 {
        assert_eq!(own.mean[2 * object..][..2], [5.0, 6.0]);
        assert_eq!(own.std[2 * object..][..2], [10.0_f32.sqrt(), 27.0_f32.sqrt()]);
    }
    assert_eq!((own.mean.len(), own.std.len()), (JOINTS, JOINTS));
    assert_eq!((&shared.mean, shared.std.as_slice()), (&own.mean, [18.5_f32.sqrt()].as_slice()));
}

#[test]
fn a_shared_deviation_pools_the_variances_and_leaves_each_mean() {
    let samples = ramps(0, &[12]);
    let at = at(0..11);
    let scaling = |scale, minimum| Scaling { scale, minimum };
    let scalings = Scalings::from([
        (Modality::CONTACT_FORCE, scaling(Scale::Shared, Some(-1.0))),
        (Modality::CONTACT_FORCE_MEAN, scaling(Scale::PerElement, None)),
    ]);
    let normalizers = Normalizers::fit(&samples, &at, &scalings, Action::Increment);
    let (shared, own) = (
        &normalizers.modalities[&Modality::CONTACT_FORCE],
        &normalizers.modalities[&Modality::CONTACT_FORCE_MEAN],
    );
    // 0 to 10 have mean 5 and variance 10. The forces on the last of 20 links are three times as large, so their
    // variance is nine times as large.
    assert_eq!((shared.mean[0], shared.mean[19]), (5.0, 15.0));
    assert_eq!(shared.mean, own.mean);
    assert_eq!(shared.std, [((19.0 * 10.0 + 90.0) / 20.0_f32).sqrt()]);
    assert_eq!((own.std[0], own.std[19]), (10.0_f32.sqrt(), 90.0_f32.sqrt()));
    // In units of the shared standard deviation, the last link's forces vary three times as much as another link's.
    let table = normalizers.vectors(&samples, &[at[0], at[10]], &[Modality::CONTACT_FORCE]);
    let span = |link: usize| table[JOINTS + link] - table[link];
    assert!((span(19) / span(0) - 3.0).abs() < 1e-6);
    // -7 + 5 N on the first link is below the minimum, and becomes -1 N. -1 + 15 N on the last link is not changed.
    let mut predicted: Vec<f32> =
        (0..JOINTS).map(|link| if link == 0 { -7.0 } else { -1.0 } / shared.std[0]).collect();
    shared.denormalize(&mut predicted);
    assert_eq!(predicted[0], -1.0);
    assert!((predicted[19] - 14.0).abs() < 1e-5, "{}", predicted[19]);
    let mut lost = vec![f32::NAN; JOINTS];
    shared.denormalize(&mut lost);
    assert!(lost.iter().all(|value| value.is_nan()), "what is not a number is not hidden by the minimum");
}

/// One episode in which each image shows `byte`, and each element of a vector has the value that `value` gives for the
/// sample and the element.
fn still(count: usize, place: FramePlace, byte: u8, value: impl Fn(usize, usize) -> f32) -> Samples {
    let (recording, layout) = (Recording { sample_rate_hz: 10.0, seed: 0 }, Layout::finger());
    let mut samples = Samples::new(recording, layout.clone(), count, place, Path::new("nowhere")).unwrap();
    let mut episode = Episode::new(layout.clone(), 0, count);
    for (index, definition) in layout.modalities.iter().enumerate() {
        let width = definition.width();
        if !definition.is_image() {
            episode.vectors[index] = (0..count * width).map(|at| value(at / width, at % width)).collect();
        } else if definition.difference_of.is_none() && place != FramePlace::Nowhere {
            episode.images[index] = vec![byte; count * width];
        }
    }
    samples.push(&episode).unwrap();
    samples
}

#[test]
fn any_constant_has_the_deviation_1_over_any_number_of_samples() {
    // Only the last element varies, by a ten-thousandth of its mean.
    let value = |sample: usize, element: usize| match element + 1 == JOINTS {
        true => 1.0 + 1e-4 * (sample % 2) as f32,
        false => 0.1 + element as f32 / 3.0,
    };
    let samples = still(40_001, FramePlace::Nowhere, 0, value);
    let many = at(0..40_000);
    let own = Scaling { scale: Scale::PerElement, minimum: None };
    let scalings = Scalings::from([(Modality::CONTACT_FORCE, own)]);
    let normalizers = Normalizers::fit(&samples, &many, &scalings, Action::Increment);
    let forces = &normalizers.modalities[&Modality::CONTACT_FORCE].std;
    assert_eq!(forces[..JOINTS - 1], [1.0; JOINTS - 1]);
    assert!((forces[JOINTS - 1] - 5e-5).abs() < 1e-7, "{forces:?}");

    let samples = still(11, FramePlace::Memory, 245, |_, _| 0.0);
    let few = at(0..10);
    let shared = Scaling { scale: Scale::Shared, minimum: None };
    let scalings = Scalings::from([(Modality::VISION, shared)]);
    let normalizers = Normalizers::fit(&samples, &few, &scalings, Action::Increment);
    assert_eq!(normalizers.modalities[&Modality::VISION].std, [1.0]);
}

#[test]
fn pixel_means_and_one_deviation_scale_frames_for_any_threads() {
    // These are more samples than are summed at once.
    let samples = ramps(0, &[3000, 3000]);
    let at = at((0..6000).filter(|sample| sample % 7 != 0));
    for modality in [Modality::VISION, Modality::FRAME_DIFFERENCE] {
        let scalings =
            Scalings::from([(modality, World::paper(Scenario::EMPTY).scaling(modality, &[]).unwrap())]);
        let fit = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| Normalizers::fit(&samples, &at, &scalings, Action::Increment))
        };
        let normalizers = fit(1);
        assert_eq!(normalizers, fit(3));
        let mut variances = 0.0;
        for pixel in [0, 1, 100, FRAME_LEN - 1] {
            let values: Vec<f64> = at
                .iter()
                .map(|&sample| match modality {
                    Modality::VISION => f64::from(samples.frame_bytes(modality, sample)[pixel]) / 255.0,
                    _ => f64::from(
                        harness_samples::frame_difference(&samples, modality, sample).nth(pixel).unwrap(),
                    ),
                })
                .collect();
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            let found = f64::from(normalizers.modalities[&modality].mean[pixel]);
            assert!((found - mean).abs() < 1e-6, "{modality} {pixel}: {found}, not {mean}");
            variances += values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / values.len() as f64;
        }
        // Each pixel takes all values of a byte equally often, so all pixels have nearly the same variance.
        let found = f64::from(normalizers.modalities[&modality].std[0]);
        assert!((found.powi(2) / (variances / 4.0) - 1.0).abs() < 0.02, "{modality}: {found}");
    }
}

/// The Python package has the same list of columns for reading and writing episodes.
#[test]
fn the_python_packages_columns_are_those_of_the_files() {
    let root = Path::new(ROOT);
    let script = "import dataclasses, importlib.util, json, sys\n\
        spec = importlib.util.spec_from_file_location('recorded', sys.argv[1])\n\
        recorded = importlib.util.module_from_spec(spec)\n\
        sys.modules['recorded'] = recorded\n\
        spec.loader.exec_module(recorded)\n\
        print(json.dumps([dataclasses.asdict(column) for column in recorded.columns(recorded.FINGER)]))";
    let output = std::process::Command::new(root.join(".venv/bin/python"))
        .args(["-c", script])
        .arg(root.join("python/harness/recorded.py"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let found: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let columns = [
        harness_tables::schema::sample_columns(&Layout::finger()),
        harness_tables::schema::image_columns(&Layout::finger()),
    ]
    .concat();
    let expected = serde_json::to_value(&columns).unwrap();
    assert!(found == expected, "python/harness/recorded.py must give {expected}");
}

/// Compares a hash of the names and values of all columns of a dataset with those of before, bit by bit. Frames depend on
/// the renderer, so other tests compare them.
#[test]
fn the_built_in_worlds_record_the_bits_that_they_did_before() {
    use polars::prelude::*;
    use sha2::{Digest, Sha256};
    let hash = |scenario| {
        let collected = Collected::new(scenario, 2);
        let mut sha = Sha256::new();
        for index in 0..4 {
            let file = std::fs::File::open(collected.episode(index)).unwrap();
            let table = ParquetReader::new(file).finish().unwrap();
            let compared = |column: &&Column| !["vision", "wrist"].contains(&column.name().as_str());
            for column in table.columns().iter().filter(compared) {
                sha.update(column.name().as_str());
                let values = column.cast(&DataType::Float64).ok().filter(|_| !column.dtype().is_string());
                match values {
                    Some(values) => {
                        values.f64().unwrap().iter().flatten().for_each(|v| sha.update(v.to_le_bytes()))
                    }
                    None => column.str().unwrap().iter().flatten().for_each(|text| sha.update(text)),
                }
            }
        }
        let hash: String = sha.finalize().iter().take(8).map(|byte| format!("{byte:02x}")).collect();
        (collected.dataset.name().to_owned(), hash)
    };
    let expected =
        [("empty-b0292fe37b44c59b", "3b11a335c6c34c76"), ("cluttered-348c5f686d8f8cba", "701531a109945c5e")];
    let found = [Scenario::EMPTY, Scenario::CLUTTERED].map(hash);
    assert_eq!(found.each_ref().map(|(name, hash)| (name.as_str(), hash.as_str())), expected);
}

// --- a dataset of its own for the test ---

/// All random values of each of three episodes: setpoints in the first second, places of boxes, and factors.
fn drawn(scene: &Scene, spec: &Simulation) -> Vec<[String; 3]> {
    let draw = |index| {
        let plan = EpisodePlan::draw(scene, spec, index).unwrap();
        let setpoints = (0..1000).step_by(100).map(|step| {
            let mut setpoint = [0.0; ARM_JOINTS];
            plan.setpoint(step, &mut setpoint);
            setpoint
        });
        let factors: Vec<f64> = plan.factors.values().collect();
        let values = [
            format!("{:?}", setpoints.collect::<Vec<_>>()),
            format!("{:?}", plan.boxes),
            format!("{factors:?}"),
        ];
        assert!(values.iter().all(|value| value != "[]"));
        values
    };
    (0..3).map(draw).collect()
}

#[test]
fn a_test_never_shares_an_episode_with_a_dataset_for_training() {
    let original = scene(Scenario::CLUTTERED);
    let edited = original.xml().replace("damping=\"3\"", "damping=\"4\"");
    let edited = Scene::from_xml(World::paper(Scenario::CLUTTERED), &edited, "edited.xml".into()).unwrap();
    let factors = || ["box_mass", "finger_stiffness"].map(str::to_owned).to_vec();
    let seeds = [0, 1, MAX_SEED];
    let of = |test| seeds.map(|seed| Simulation { seed, test, factors: factors(), ..short() });
    let (mut trained, mut names) = ([(); 3].map(|()| BTreeSet::new()), BTreeSet::new());
    for (scene, spec) in [&original, &edited].iter().flat_map(|scene| of(false).map(|spec| (scene, spec))) {
        names.insert(dataset_of(Path::new(""), scene, &spec).name().to_owned());
        for values in drawn(scene, &spec) {
            for (seen, value) in trained.iter_mut().zip(values) {
                seen.insert(value);
            }
        }
    }
    // The edited world has the same motions, which is what a test must not have.
    assert_eq!(trained.each_ref().map(BTreeSet::len), [9, 9, 9]);
    for (scene, spec) in [&original, &edited].iter().flat_map(|scene| of(true).map(|spec| (scene, spec))) {
        assert!(names.insert(dataset_of(Path::new(""), scene, &spec).name().to_owned()));
        for values in drawn(scene, &spec) {
            let shared = trained.iter().zip(&values).filter(|(seen, value)| seen.contains(*value));
            assert_eq!(shared.count(), 0, "{spec:?}");
        }
    }
}

#[test]
fn all_of_a_test_dataset_and_nothing_else_is_for_the_test() {
    let collected = Collected::new(Scenario::EMPTY, 2);
    let test = Simulation { episodes: 2, test: true, ..short() };
    let test = dataset_of(collected.root.path(), &collected.scene, &test);
    collect(&test, &collected.scene, 2, &Silent).unwrap();
    assert_eq!(Dataset::at(test.folder()).unwrap().spec(), test.spec());
    let (own, test) = (AnyDataset::from(collected.dataset), AnyDataset::from(test));
    let samples = own.load_with_test(Some(&test), FramePlace::Memory, &Silent).unwrap();
    let alone = test.load(FramePlace::Memory, &Silent).unwrap();
    let Partition { training, validation, test } =
        samples.partition(&Split::default(), &Window::TRANSITION).unwrap();
    let episodes = |part: &[Sample]| part.iter().map(|at| samples.place(*at).0).collect::<BTreeSet<_>>();
    assert_eq!(episodes(&training), BTreeSet::from([0, 1, 2]));
    assert_eq!(episodes(&validation), BTreeSet::from([3]));
    assert_eq!(episodes(&test), BTreeSet::from([0, 1]));
    assert_eq!(test.len(), alone.windows(&Window::TRANSITION).len());
    for (at, alone_at) in test.iter().zip(alone.windows(&Window::TRANSITION)) {
        assert_eq!(samples.place(*at), alone.place(alone_at));
        let modality = Modality::CONTACT_FORCE;
        assert_eq!(samples.vector(modality, *at), alone.vector(modality, alone_at));
        assert_eq!(samples.frame_bytes(Modality::VISION, *at), alone.frame_bytes(Modality::VISION, alone_at));
    }
}
