//! The paper's claims, judged by made-up tables: tables that agree with the paper, tables that disagree, and tables of
//! networks that learned nothing.

use crate::common::finger::JOINTS;
use crate::common::{finish, harness, succeed};
use harness::claims::{
    Claim, Condition, Each, Judgment, Measured, Verdict, choose, corrected, judge, load, runs,
};
use harness::judge::MetricRow;
use harness::learning::training::{Epoch, Losses, TOTAL};
use harness::metrics::contact::Contact;
use harness::metrics::{Direction, Metric, Row};
use harness::registry::{ForceRows, Outcome, Provenance, Registry};
use harness::seal;
use harness::spec::{self, Experiment, Layout, Modality, RunSpec, Scenario, Task};
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use std::sync::LazyLock;
use std::time::Duration;
use tempfile::TempDir;

mod error_rates;

const FILE: &str = "experiments/claims.yaml";
const EXPERIMENTS: [&str; 2] = ["single_to_multi", "multi_to_multi"];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The claims of the repository. Most tests check all of them.
static CLAIMS: LazyLock<Vec<Claim>> = LazyLock::new(|| load(&root().join(FILE)).unwrap().claims);

/// An experiment of the repository with these seeds.
fn experiment(name: &str, seeds: &[u64]) -> Experiment {
    let path = root().join(format!("experiments/{name}.yaml"));
    spec::load(&path, &[format!("seeds={seeds:?}")], false).unwrap()
}

// --- made-up tables ---

/// How a run's results compare with the paper.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Says {
    Same,
    Opposite,
    /// The networks' results agree with the paper, but the networks are no better than the training mean. Results that
    /// depend on the dataset alone disagree.
    Nothing,
}
use Says::{Nothing, Opposite, Same};

impl Says {
    /// The error of a network, plus noise.
    fn error(self, same: f64, opposite: f64, noise: f64) -> f64 {
        match self {
            Same => same + noise,
            Opposite => opposite + noise,
            Nothing => 1.0 + 0.01 * (same + noise - 0.5),
        }
    }
}

/// The cell of a run.
#[derive(Clone, Copy)]
struct Place {
    vision: bool,
    cluttered: bool,
    /// 0 for the smallest of the paper's latent sizes, 1 for the middle, 2 for the largest.
    size: usize,
}

impl Place {
    fn of(spec: &RunSpec) -> Self {
        let vision = spec.input.contains(&Modality::VISION);
        let sizes = if vision { [16, 64, 128] } else { [2, 4, 16] };
        Self {
            vision,
            cluttered: spec.scenario == Scenario::CLUTTERED.into(),
            size: sizes.iter().position(|latent| Some(*latent) == spec.latent()).unwrap(),
        }
    }
}

/// The task and quantity of a metric.
#[derive(Clone, Copy)]
struct Of {
    task: Task,
    modality: Modality,
    direction: Option<Direction>,
    index: Option<u32>,
}

/// Two errors of a cell: one is smallest in the cell where the paper has the smallest, the other in another cell.
fn errors(place: Place, of: Of) -> [f64; 2] {
    let Place { vision, cluttered, size } = place;
    let (same, opposite) = match (of.task, of.modality, vision) {
        (Task::Prediction, Modality::PROPRIOCEPTION, false) if cluttered => {
            ([0.6, 0.6, 0.5], [0.4, 0.4, 0.5])
        }
        (Task::Prediction, Modality::PROPRIOCEPTION, false) => ([0.5, 0.5, 0.6], [0.5, 0.5, 0.4]),
        (Task::Prediction, Modality::PROPRIOCEPTION, true) => ([0.2, 0.1, 0.2], [0.6, 0.8, 0.7]),
        (Task::Prediction, Modality::CONTACT_FORCE, false) => ([0.7; 3], [0.3; 3]),
        (Task::Prediction, Modality::CONTACT_FORCE, true) if cluttered => ([0.4, 0.3, 0.2], [0.6, 0.7, 0.8]),
        (Task::Prediction, Modality::CONTACT_FORCE, true) => ([0.3, 0.2, 0.3], [0.6, 0.8, 0.7]),
        (Task::Reconstruction, Modality::PROPRIOCEPTION, false) => ([0.6, 0.5, 0.6], [0.4, 0.6, 0.5]),
        (Task::Reconstruction, Modality::PROPRIOCEPTION, true) => ([0.43, 0.43, 0.4], [0.9, 0.5, 0.7]),
        _ => ([0.5; 3], [0.5; 3]),
    };
    // Lateral angles are easier, lateral forces harder. The difference is larger for the smallest latent size.
    let harder = match of.modality {
        Modality::PROPRIOCEPTION => Direction::FLEXION_EXTENSION,
        _ => Direction::ADDUCTION_ABDUCTION,
    };
    let difference = if (of.task, size) == (Task::Reconstruction, 0) { 0.05 } else { 0.02 };
    let by_direction = match of.direction {
        None => 0.0,
        Some(direction) if direction == harder => difference,
        Some(_) => -difference,
    };
    let fingertip = of.index.is_some_and(|index| index as usize >= JOINTS - 2);
    let detail = by_direction + if fingertip { 0.05 } else { 0.0 };
    [same[size] + detail, opposite[size] - detail]
}

/// The relative errors of the frame difference, overall and on the arm and the finger: those that agree with the paper,
/// and those that disagree.
fn image_errors(place: Place) -> [(Metric, [f64; 2]); 3] {
    let finger = [[0.85, 0.75], [0.9, 0.7], [0.9, 0.7]][place.size];
    [
        (Metric::RelativeError, [0.5, 0.5]),
        (Metric::RelativeError.in_region("arm"), [0.2, 0.8]),
        (Metric::RelativeError.in_region("finger"), finger),
    ]
}

/// The epoch after which the validation loss falls by less than 5 % in total.
fn converged(says: Says, place: Place) -> usize {
    let epoch = match place {
        Place { vision: true, size, .. } => [40, 25, 10][size],
        Place { cluttered: true, size, .. } => [40, 40, 10][size],
        Place { cluttered: false, size, .. } => [40, 10, 40][size],
    };
    if says == Opposite { 50 - epoch } else { epoch }
}

/// The mean force on each link, N.
fn forces(says: Says, cluttered: bool) -> [f64; JOINTS] {
    let [proximal, distal] = match (says, cluttered) {
        (Same, false) => [0.1, 2.0],
        (Same, true) => [0.5, 3.0],
        (Opposite | Nothing, false) => [2.0, 0.1],
        (Opposite | Nothing, true) => [1.0, 0.5],
    };
    std::array::from_fn(|link| if link < 15 { proximal } else { distal })
}

/// R2 of persistence: high where the motion is quasi-static.
fn persistence_r2(says: Says, modality: Modality) -> f64 {
    match (says, modality) {
        (Same, Modality::PROPRIOCEPTION) => 0.6,
        (Same, _) => 0.55,
        (_, Modality::PROPRIOCEPTION) => 0.3,
        _ => 0.1,
    }
}

/// WMAPE of persistence for the force: smaller than that of networks without vision for all links together.
fn persistence_wmape(place: Place, index: Option<u32>) -> f64 {
    if place.vision || index.is_some() { 99.0 } else { 65.0 }
}

/// The outcome of a run whose results are `says`.
fn outcome(says: Says, spec: &RunSpec) -> Outcome {
    let place = Place::of(spec);
    // Seeds and latent sizes differ slightly, like those of real runs.
    let noise = 1e-3 * ((spec.seed * 7 + spec.latent().unwrap() as u64 * 3) % 5) as f64;
    let error = |[same, opposite]: [f64; 2]| says.error(same, opposite, noise);
    let mut metrics = Vec::new();
    let mut push = |model, of: Of, metric, value| {
        let Of { task, modality, direction, index } = of;
        let row = Row { modality, direction, index, metric, value: Some(value), unit: String::new() };
        metrics.push(MetricRow { task, model: String::from(model), horizon: 1, given: None, row });
    };
    for (task, modalities) in [(Task::Prediction, &spec.output), (Task::Reconstruction, &spec.input)] {
        for &modality in modalities {
            let joints =
                (0..JOINTS as u32).map(|index| (Some(Direction::FINGER[index as usize % 2]), Some(index)));
            let directions = Direction::FINGER.map(|direction| (Some(direction), None));
            let groups = [(None, None)].into_iter().chain(directions).chain(joints);
            for (direction, index) in groups.filter(|_| !Layout::finger()[modality].is_image()) {
                let of = Of { task, modality, direction, index };
                let error = error(errors(place, of));
                // A network that has learned anything predicts angles better than persistence.
                let is_easy =
                    (task, modality) == (Task::Prediction, Modality::PROPRIOCEPTION) && says != Nothing;
                push("network", of, Metric::R2, 1.0 - if is_easy { 0.4 * error } else { error });
                push("network", of, Metric::Rmse, error);
                push("network", of, Metric::Smape, 100.0 * error);
                push("network", of, Metric::Wmape, 100.0 * error);
                push("training_mean", of, Metric::R2, 0.0);
                push("training_mean", of, Metric::Rmse, 1.0);
                push("training_mean", of, Metric::Smape, 100.0);
                push("training_mean", of, Metric::Wmape, 150.0);
                if task == Task::Prediction {
                    push("persistence", of, Metric::R2, persistence_r2(says, modality));
                    push("persistence", of, Metric::Wmape, persistence_wmape(place, index));
                }
            }
            if modality == Modality::FRAME_DIFFERENCE {
                let of = Of { task, modality, direction: None, index: None };
                for (metric, errors) in image_errors(place) {
                    push("network", of, metric, error(errors));
                }
            }
        }
    }
    let knee = converged(says, place) + spec.seed as usize;
    // A network's validation loss of an output is its error in the test, that of the finger for images.
    let terms = |task, modalities: &[Modality]| -> Losses {
        let of = |modality: &Modality| {
            let whole = Of { task, modality: *modality, direction: None, index: None };
            let errors = match *modality {
                Modality::FRAME_DIFFERENCE => image_errors(place)[2].1,
                _ => errors(place, whole),
            };
            (modality.name().to_owned(), error(errors))
        };
        modalities.iter().map(of).collect()
    };
    let epoch = |epoch: usize| {
        // If a network learns nothing, its loss falls by 3 % in all.
        let steep = if says == Nothing { 0.0 } else { knee.saturating_sub(epoch) as f64 };
        let loss = 1.0 + 5e-4 * (60 - epoch) as f64 + steep;
        let mut losses = terms(Task::Prediction, &spec.output);
        losses.insert(TOTAL.to_owned(), loss);
        (Task::Prediction, Epoch { epoch, train: losses.clone(), validation: losses, seconds: 1.0 })
    };
    let mut reconstruction = terms(Task::Reconstruction, &spec.input);
    reconstruction.insert(TOTAL.to_owned(), 1.0);
    let reconstruction =
        Epoch { epoch: 1, train: reconstruction.clone(), validation: reconstruction, seconds: 1.0 };
    let contact =
        |mean: f64| Contact { samples: 1000, contacts: 500, mean, quantiles: None, max: Some(10.0 * mean) };
    let forces = (0..4).map(|episode| {
        let force = |force: f64| contact(force * (1.0 + 0.01 * f64::from(episode)));
        let links = forces(says, place.cluttered).map(force).to_vec();
        ForceRows { modality: Modality::CONTACT_FORCE, episode: Some(episode), links }
    });
    let steps = if says == Opposite { 2 - place.size } else { place.size };
    Outcome {
        epochs: (1..=60).map(epoch).chain([(Task::Reconstruction, reconstruction)]).collect(),
        metrics,
        forces: forces.collect(),
        parameters: 1000 + 10 * steps,
        ..Outcome::default()
    }
}

/// Writes an experiment's runs with these seeds. `says` returns the results of a seed.
fn write(registry: &Registry, name: &str, seeds: &[u64], says: impl Fn(u64) -> Says) {
    let experiment = experiment(name, seeds);
    for spec in experiment.runs() {
        finish_run(registry, name, &spec, says(spec.seed));
    }
}

/// Writes one run.
fn finish_run(registry: &Registry, experiment: &str, spec: &RunSpec, says: Says) {
    finish_with(registry, experiment, spec, &outcome(says, spec));
}

fn finish_with(registry: &Registry, experiment: &str, spec: &RunSpec, outcome: &Outcome) {
    let folder = registry.run(experiment, spec, &format!("{}-made-up", spec.scenario));
    let run = registry.claim(&folder).unwrap().unwrap();
    let record = run.begin(spec, &Layout::finger(), &Provenance::default()).unwrap();
    // Claims read only tables, but the record must also list the networks.
    for task in &spec.tasks {
        std::fs::write(folder.checkpoint(*task), "made up").unwrap();
    }
    run.finish(record, outcome).unwrap();
}

/// A results folder with runs of all experiments that claims use.
fn results(seeds: &[u64], says: impl Fn(u64) -> Says) -> (TempDir, Registry) {
    let folder = tempfile::tempdir().unwrap();
    let registry = Registry::new(folder.path());
    EXPERIMENTS.iter().for_each(|name| write(&registry, name, seeds, &says));
    (folder, registry)
}

/// The judgments of all claims, one for each scenario.
fn judgments(registry: &Registry, quick: bool) -> Vec<Judgment<'static>> {
    let claims: Vec<&'static Claim> = CLAIMS.iter().collect();
    let runs = runs(registry, &claims, &[], quick).unwrap();
    claims.into_iter().flat_map(|claim| judge(&runs, claim, quick).unwrap()).collect()
}

#[track_caller]
fn assert_verdicts(registry: &Registry, expected: impl Fn(&Judgment) -> Verdict) {
    for judgment in judgments(registry, false) {
        let Judgment { claim, scenario, measured, .. } = &judgment;
        let found = judgment.verdict();
        assert_eq!(found, expected(&judgment), "{} {scenario:?}: {measured:?}", claim.id());
    }
}

fn about_the_dataset(judgment: &Judgment) -> bool {
    judgment.measured.each != Each::Seed
}

/// The verdict on a claim whose values all satisfy the condition, or all violate it. A value of a whole dataset has no
/// interval, because the tables have one dataset.
fn decided(judgment: &Judgment, satisfied: bool) -> Verdict {
    match judgment.measured.each {
        Each::Dataset => Verdict::OneValue { each: Each::Dataset, satisfied },
        _ if satisfied => Verdict::Holds,
        _ => Verdict::DoesNotHold,
    }
}

/// The number of judgments whose value is that of a whole dataset: two claims in two scenarios.
const OF_DATASETS: usize = 4;

// --- verdicts ---

#[test]
fn every_claim_holds_where_the_tables_agree_with_the_paper() {
    let (_folder, registry) = results(&[0, 1, 2], |_| Same);
    assert_verdicts(&registry, |judgment| decided(judgment, true));
}

#[test]
fn no_claim_holds_where_the_tables_say_the_opposite() {
    let (_folder, registry) = results(&[0, 1, 2], |_| Opposite);
    assert_verdicts(&registry, |judgment| decided(judgment, false));
}

#[test]
fn no_claim_holds_by_networks_that_learned_nothing() {
    let (_folder, registry) = results(&[0, 1, 2], |_| Nothing);
    let (mut untestable, mut faint) = (0, 0);
    for judgment in judgments(&registry, false) {
        let Judgment { claim, measured, required, .. } = &judgment;
        let verdict = judgment.verdict();
        if claim.requires.is_some() {
            assert_eq!(verdict, Verdict::NotTestable, "{}: {measured:?} {required:?}", claim.id());
            let (low, high) = judgment.interval().unwrap().bounds.unwrap();
            untestable += 1;
            faint += usize::from(claim.condition.satisfied_by(low) && claim.condition.satisfied_by(high));
        } else {
            assert_eq!(verdict, decided(&judgment, false), "{}: {measured:?}", claim.id());
        }
    }
    // Without their requirements, most of these claims would hold.
    assert!(4 * faint > 3 * untestable, "{faint} of {untestable}");
}

#[test]
fn the_best_latent_size_is_that_of_the_validation() {
    let moderate = "moderate_latent_for_proprioception";
    let value = |loss: f64| {
        let folder = tempfile::tempdir().unwrap();
        let registry = Registry::new(folder.path());
        for spec in experiment("multi_to_multi", &[0]).runs() {
            let mut outcome = outcome(Same, &spec);
            if spec.latent() == Some(128) {
                for (_, epoch) in &mut outcome.epochs {
                    epoch.validation.insert(Modality::PROPRIOCEPTION.name().to_owned(), loss);
                }
            }
            finish_with(&registry, "multi_to_multi", &spec, &outcome);
        }
        let (_, measured, _) = values(&registry).into_iter().find(|(id, ..)| id == moderate).unwrap();
        measured.interval().unwrap().mean
    };
    // In the test, SMAPE is 20.3 % at latent 16, 10.2 % at 64 and 20.4 % at 128.
    assert!((value(1.0) - 10.1).abs() < 1e-9);
    assert!((value(0.0) - 10.2).abs() < 1e-9);
}

#[test]
fn claims_are_undecided_where_seeds_disagree() {
    let (_folder, registry) = results(&[0, 1, 2, 3], |seed| if seed % 2 == 0 { Same } else { Opposite });
    for judgment in judgments(&registry, false).iter().filter(|judgment| !about_the_dataset(judgment)) {
        assert_eq!(judgment.verdict(), Verdict::Undecided, "{}", judgment.claim.id());
        let Measured { each: Each::Seed, values, .. } = &judgment.measured else { panic!("{judgment:?}") };
        assert_eq!(values.keys().copied().collect::<Vec<_>>(), [(0, 0), (0, 1), (0, 2), (0, 3)]);
    }
}

#[test]
fn a_single_seed_decides_nothing_but_shows_where_it_points() {
    for (says, satisfied) in [(Same, true), (Opposite, false)] {
        let (_folder, registry) = results(&[7], |_| says);
        assert_verdicts(&registry, |judgment| match about_the_dataset(judgment) {
            true => decided(judgment, satisfied),
            false => Verdict::OneValue { each: Each::Seed, satisfied },
        });
    }
}

#[test]
fn seeds_that_repeat_a_value_of_the_dataset_do_not_decide_it() {
    let (folder, _registry) = results(&[0, 1, 2], |_| Same);
    let printed = succeed(folder.path(), &["claims", "force_is_quasi_static"]);
    assert_eq!(printed.matches("undecided: 1 dataset, agrees").count(), 2, "{printed}");
    assert!(printed.contains("force_is_quasi_static empty: dataset 0: 0.5500\n"), "{printed}");
    let plan = succeed(folder.path(), &["claims", "force_is_quasi_static", "--plan"]);
    let expected =
        "1 more dataset, 9 runs, about 0.0 s, would give an interval to force_is_quasi_static empty:\n";
    assert!(plan.contains(expected), "{plan}");
    assert!(plan.contains("for seed in 1; do "), "{plan}");
    works(&plan, "new");
}

#[test]
fn claims_without_their_runs_are_undecided() {
    let folder = tempfile::tempdir().unwrap();
    let registry = Registry::new(folder.path());
    assert_verdicts(&registry, |_| Verdict::NoData);
    write(&registry, "single_to_multi", &[0, 1, 2], |_| Same);
    assert_verdicts(&registry, |judgment| {
        let is_there = judgment.claim.experiments.iter().all(|name| name == "single_to_multi");
        if is_there { decided(judgment, true) } else { Verdict::NoData }
    });
}

#[test]
fn a_seed_counts_only_when_all_its_runs_are_there() {
    let (_folder, registry) = results(&[0, 1, 2], |_| Same);
    // The fourth seed has only runs of the smallest latent size.
    for name in EXPERIMENTS {
        let mut experiment = experiment(name, &[9]);
        experiment.latent.truncate(1);
        for spec in experiment.runs() {
            finish_run(&registry, name, &spec, Opposite);
        }
    }
    for judgment in judgments(&registry, false).iter().filter(|judgment| !about_the_dataset(judgment)) {
        for measured in [Some(&judgment.measured), judgment.required.as_ref()].into_iter().flatten() {
            assert_eq!((measured.each, measured.values.len()), (Each::Seed, 3), "{}", judgment.claim.id());
        }
    }
}

#[test]
fn runs_of_other_settings_are_refused_and_chosen_by_name() {
    let (folder, registry) = results(&[0, 1, 2], |_| Same);
    let mut other = experiment("single_to_multi", &[0, 1, 2]);
    other.training.batch_size = 16;
    for spec in other.runs().into_iter().take(5) {
        finish_run(&registry, "single_to_multi", &spec, Opposite);
    }
    let reads_it = |claim: &Claim| claim.experiments.iter().any(|name| name == "single_to_multi");
    assert_verdicts(&registry, |judgment| {
        if reads_it(judgment.claim) { Verdict::Mixed } else { decided(judgment, true) }
    });
    let refused = "the runs of single_to_multi differ in training.batch_size (16, 1024); select some, for example with \
                   `--where 'single_to_multi:training.batch_size=1024'`\n";
    let printed = succeed(folder.path(), &["claims", "--all"]);
    assert!(printed.contains("settings differ") && printed.contains(refused), "{printed}");
    // The options in the message work as they are printed.
    let option = ["--where", "single_to_multi:training.batch_size=1024"];
    let chosen = succeed(folder.path(), &[&["claims", "--all"][..], &option].concat());
    let summary = format!(" 0 do not hold, {OF_DATASETS} undecided, 0 not testable; ");
    assert!(chosen.contains(&summary), "{chosen}");
    // Only five runs have the other batch size, which is enough only for claims about forces.
    let option = ["--where", "single_to_multi:training.batch_size=16"];
    let chosen = succeed(folder.path(), &[&["claims", "force_errors_stay_high"][..], &option].concat());
    assert!(chosen.contains("no data") && !chosen.contains("undecided: no data"), "{chosen}");
}

#[test]
fn a_variant_is_a_setting_that_a_query_may_tell_apart() {
    let folder = tempfile::tempdir().unwrap();
    let registry = Registry::new(folder.path());
    let mut sweep = experiment("single_to_multi", &[0, 1]);
    sweep.vary = [("training.kl_weight".to_owned(), vec![0.0, 0.5].into())].into_iter().collect();
    for spec in sweep.runs() {
        finish_run(&registry, "single_to_multi", &spec, Same);
    }
    assert!(judgments(&registry, false).iter().all(|judgment| {
        let reads_it = judgment.claim.experiments.iter().any(|name| name == "single_to_multi");
        judgment.verdict() == if reads_it { Verdict::Mixed } else { Verdict::NoData }
    }));
    let query = "select scenario, seed, avg(value) as value from metrics where variant = 'kl_weight=0.5' and metric = \
                 'r2' group by scenario, seed";
    let claims =
        load_text(&ONE.replace(
            "select scenario, seed, avg(value) as value from metrics group by scenario, seed",
            query,
        ));
    let claims = claims.unwrap();
    let judged = judge(&runs(&registry, &[&claims[0]], &[], false).unwrap(), &claims[0], false).unwrap();
    assert_eq!(judged[0].measured.values.len(), 2, "{judged:?}");
}

/// The values by which all claims are judged.
fn values(registry: &Registry) -> Vec<(String, Measured, Option<Measured>)> {
    let judgments = judgments(registry, false).into_iter();
    judgments.map(|judgment| (judgment.claim.id().to_owned(), judgment.measured, judgment.required)).collect()
}

/// The compacted files of all tables, with their contents.
fn compacted(root: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let files = glob::glob(&format!("{}/compacted/*/*.parquet", root.display())).unwrap();
    files.map(|path| path.unwrap()).map(|path| (path.clone(), std::fs::read(path).unwrap())).collect()
}

#[test]
fn values_are_the_same_from_compacted_tables_even_damaged_ones() {
    // Enough runs of each experiment to be compacted.
    let seeds: Vec<u64> = (0..12).collect();
    let (folder, registry) = results(&seeds, |seed| if seed % 3 == 0 { Opposite } else { Same });
    // A file in the place of the folder prevents compaction.
    let in_the_way = folder.path().join("compacted");
    std::fs::write(&in_the_way, "").unwrap();
    let expected = values(&registry);
    assert!(expected.iter().all(|(_, measured, _)| !measured.values.is_empty()));
    std::fs::remove_file(&in_the_way).unwrap();
    // Files that were written just now are not compacted.
    std::thread::sleep(Duration::from_millis(3200));
    assert_eq!(values(&registry), expected);
    let whole = compacted(folder.path());
    let tables = |experiment: &str| {
        let is_of = |path: &Path| path.parent().unwrap().ends_with(experiment);
        let names = whole.iter().filter(|(path, _)| is_of(path)).map(|(path, _)| path);
        names
            .map(|path| path.file_name().unwrap().to_string_lossy().split('-').next().unwrap().to_owned())
            .collect::<Vec<_>>()
    };
    assert_eq!(tables("single_to_multi"), ["epochs", "metrics"]);
    assert_eq!(tables("multi_to_multi"), ["epochs", "metrics"]);
    for (path, bytes) in &whole {
        let mut damaged = bytes.clone();
        damaged[bytes.len() / 3] ^= 1;
        std::fs::write(path, damaged).unwrap();
    }
    assert_eq!(values(&registry), expected);
    assert_eq!(compacted(folder.path()), whole, "the damaged files are repaired");
}

#[test]
fn forces_are_read_from_one_run_of_each_dataset() {
    let (folder, registry) = results(&[0, 1], |_| Same);
    let expected = values(&registry);
    let mut removed = 0;
    for record in registry.records() {
        if (record.spec.latent(), record.spec.seed) != (Some(2), 0) {
            let run = folder.path().join("runs").join(&record.experiment).join(&record.run);
            std::fs::remove_file(run.join("forces.parquet")).unwrap();
            removed += 1;
        }
    }
    assert!(removed > 20, "{removed}");
    assert_eq!(values(&registry), expected);
}

#[test]
fn runs_of_an_older_method_are_left_out() {
    let (_folder, registry) = results(&[0, 1], |_| Opposite);
    // The folders get the names that an older version would have given them.
    for name in EXPERIMENTS {
        for entry in std::fs::read_dir(registry.root().join("runs").join(name)).unwrap() {
            age(&entry.unwrap().path());
        }
    }
    // Older runs count if there are no newer ones.
    assert_verdicts(&registry, |judgment| decided(judgment, false));
    EXPERIMENTS.iter().for_each(|name| write(&registry, name, &[0, 1], |_| Same));
    assert_verdicts(&registry, |judgment| decided(judgment, true));
}

/// Changes a run to the previous revision.
fn age(folder: &Path) {
    let record: serde_json::Value =
        serde_json::from_slice(&std::fs::read(folder.join("run.json")).unwrap()).unwrap();
    let text = |key: &str| record[key].as_str().unwrap().to_owned();
    let name = |revision: u32| {
        let digest = Sha256::digest(format!("{} {} {revision}", text("spec_hash"), text("dataset")));
        let hash: String = digest.iter().take(4).map(|byte| format!("{byte:02x}")).collect();
        format!("{}-{hash}", text("run").rsplit_once('-').unwrap().0)
    };
    let now =
        (1..100).find(|revision| name(*revision) == text("run")).expect("the id is a hash of the revision");
    let mut older = record.clone();
    older["run"] = name(now - 1).into();
    older[seal::KEY] = seal::BLANK.into();
    seal::write(&folder.join("run.json"), format!("{older:#}\n").into_bytes()).unwrap();
    std::fs::rename(folder, folder.with_file_name(name(now - 1))).unwrap();
}

#[test]
fn quick_claims_are_about_quick_runs() {
    let folder = tempfile::tempdir().unwrap();
    let registry = Registry::new(folder.path());
    for name in EXPERIMENTS {
        for spec in experiment(name, &[0, 1]).runs() {
            finish_run(&registry, &format!("{name}-quick"), &spec, Same);
        }
    }
    assert_verdicts(&registry, |_| Verdict::NoData);
    for judgment in judgments(&registry, true) {
        assert_eq!(judgment.verdict(), decided(&judgment, true), "{}", judgment.claim.id());
    }
}

// --- several datasets, readings, plans ---

/// Writes the runs of an experiment with these settings. `says` returns the results of a run.
fn write_with(registry: &Registry, name: &str, overrides: &[&str], says: impl Fn(&RunSpec) -> Says) {
    let path = root().join(format!("experiments/{name}.yaml"));
    let overrides: Vec<String> = overrides.iter().map(|text| text.to_string()).collect();
    let experiment = spec::load(&path, &overrides, false).unwrap();
    for spec in experiment.runs() {
        finish_run(registry, name, &spec, says(&spec));
    }
}

#[test]
fn several_datasets_count_as_datasets_whatever_their_seeds_say() {
    let datasets = |says: fn(&RunSpec) -> Says| {
        let folder = tempfile::tempdir().unwrap();
        let registry = Registry::new(folder.path());
        for name in ["single_to_multi", "multi_to_multi"] {
            write_with(&registry, name, &["seeds=[0,1]", "vary={simulation.seed: [0, 1, 2]}"], says);
        }
        (folder, registry)
    };
    let (_folder, registry) = datasets(|_| Same);
    for judgment in &judgments(&registry, false) {
        assert_eq!(judgment.verdict(), Verdict::Holds, "{}: {judgment:?}", judgment.claim.id());
        if !about_the_dataset(judgment) {
            let places: Vec<_> = judgment.measured.values.keys().copied().collect();
            assert_eq!(places, [(0, 0), (0, 1), (1, 0), (1, 1), (2, 0), (2, 1)]);
            assert_eq!(judgment.measured.estimate().unwrap().count(), 3);
        }
    }
    // Four of six values agree with the paper, but one dataset disagrees, so the claims are undecided.
    let (folder, registry) = datasets(|spec| if spec.dataset_seed() == 2 { Opposite } else { Same });
    let mut undecided = 0;
    for judgment in &judgments(&registry, false) {
        if !about_the_dataset(judgment) {
            // A claim is not testable if its requirement is undecided.
            let verdict = judgment.verdict();
            let id = judgment.claim.id();
            assert!(matches!(verdict, Verdict::Undecided | Verdict::NotTestable), "{id}: {verdict}");
            undecided += usize::from(verdict == Verdict::Undecided);
        }
    }
    assert!(undecided > 20, "{undecided}");
    let one = succeed(folder.path(), &["claims", "force_errors_stay_high"]);
    assert!(one.contains("force_errors_stay_high empty: dataset 0 seed 0: -5.1"), "{one}");
    // The plan's commands can be pasted into a shell.
    let plan =
        succeed(folder.path(), &["claims", "force_errors_stay_high", "vision_improves_force", "--plan"]);
    assert!(plan.contains(" more dataset"), "{plan}");
    assert!(plan.contains("for seed in 3 "), "{plan}");
    works(&plan, "new");
}

#[test]
fn a_plan_adds_the_seeds_that_make_pairs_with_the_existing_runs() {
    let folder = tempfile::tempdir().unwrap();
    let registry = Registry::new(folder.path());
    write(&registry, "single_to_multi", &[0, 1], |_| Same);
    write(&registry, "multi_to_multi", &[0], |_| Same);
    let plan = succeed(folder.path(), &["claims", "vision_improves_force", "--plan"]);
    let commands: Vec<&str> = plan.lines().filter(|line| line.starts_with("  ")).collect();
    assert!(
        !commands.is_empty() && commands.iter().all(|line| line.contains("run multi_to_multi ")),
        "{plan}"
    );
    assert!(commands.iter().all(|line| line.ends_with("'seeds=[1]'")), "{plan}");
    works(&plan, "new");
    // Each experiment lacks a seed of the other one. One of the two is enough for a second value.
    write(&registry, "multi_to_multi", &[2], |_| Same);
    let plan = succeed(folder.path(), &["claims", "vision_improves_force", "--plan"]);
    let commands: Vec<&str> = plan.lines().filter(|line| line.starts_with("  ")).collect();
    assert!(
        !commands.is_empty() && commands.iter().all(|line| line.contains("run multi_to_multi ")),
        "{plan}"
    );
    assert!(commands.iter().all(|line| line.ends_with("'seeds=[1]'")), "{plan}");
}

/// Runs every command of a plan in a shell as a dry run, which must plan new runs.
#[track_caller]
fn works(plan: &str, expected: &str) {
    let commands: Vec<&str> = plan.lines().filter_map(|line| line.strip_prefix("  ")).collect();
    assert!(!commands.is_empty(), "{plan}");
    for command in commands {
        let dry = match command.strip_suffix("; done") {
            Some(inner) => format!("{inner} --dry-run || exit 1; done"),
            None => format!("{command} --dry-run"),
        };
        let harness = assert_cmd::cargo::cargo_bin!("harness");
        let script = format!("harness() {{ {} \"$@\"; }}\n{dry}", harness.display());
        let mut shell = std::process::Command::new("sh");
        let output = shell.current_dir(root()).args(["-c", &script]).output().unwrap();
        let said = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success(), "{command}: {}", String::from_utf8_lossy(&output.stderr));
        assert!(
            said.lines().any(|line| line.starts_with("run ") && line.contains(expected)),
            "{command}: {said}"
        );
    }
}

#[test]
fn the_plan_says_how_many_more_seeds_would_decide() {
    let (folder, _registry) = results(&[0, 1, 2], |seed| if seed == 0 { Opposite } else { Same });
    let plan = succeed(folder.path(), &["claims", "--plan"]);
    assert!(plan.contains(" more seed"), "{plan}");
    works(&plan, "new");
    let (folder, _registry) = results(&[0], |_| Same);
    let plan = succeed(folder.path(), &["claims", "force_errors_stay_high", "--plan"]);
    let expected =
        "1 more seed, 3 runs, about 0.0 s, would give an interval to force_errors_stay_high empty:\n";
    assert!(plan.contains(expected), "{plan}");
    assert!(plan.contains("'scenarios=[empty]' 'seeds=[1]'"), "{plan}");
    works(&plan, "new");
    let (folder, _registry) = results(&[0, 1, 2], |_| Same);
    let plan = succeed(folder.path(), &["claims", "force_errors_stay_high", "--plan"]);
    assert_eq!(plan, "no measured claim is undecided\n");
}

#[test]
fn a_correction_for_many_claims_stands_beside_the_verdicts() {
    // Each of these claims holds at 5 %, with an uncorrected p-value of about 0.01.
    let seeds: Vec<u64> = (0..5).collect();
    let (folder, registry) = results(&seeds, |seed| if seed == 4 { Nothing } else { Same });
    let judged = judgments(&registry, false);
    let both: Vec<(f64, f64)> = judged
        .iter()
        .zip(corrected(&judged))
        .filter_map(|(judgment, corrected)| Some((judgment.p_value()?, corrected?)))
        .collect();
    assert!(both.len() > 10 && both.iter().all(|(p, corrected)| corrected >= p));
    // Holm's correction multiplies the smallest p-value by the number of tests.
    let least = |of: fn(&(f64, f64)) -> f64| both.iter().map(of).fold(1.0, f64::min);
    assert_eq!(least(|both| both.1), (least(|both| both.0) * both.len() as f64).min(1.0));
    let is_decided = |one: &Judgment| matches!(one.verdict(), Verdict::Holds | Verdict::DoesNotHold);
    let unsure = judged
        .iter()
        .zip(corrected(&judged))
        .filter(|(one, p)| is_decided(one) && p.is_some_and(|p| p >= 0.05));
    let unsure = unsure.count();
    let printed = succeed(folder.path(), &["claims", "--all"]);
    assert_eq!(printed.matches("holds *").count() + printed.matches("hold *").count(), unsure, "{printed}");
    assert!(
        unsure > 0 && printed.contains(&format!("* {unsure} of these verdicts are undecided after Holm"))
    );
}

/// Writes the runs of reproduction.yaml with these latent sizes on two datasets.
fn write_reproduction(
    registry: &Registry,
    sizes: impl Fn(&RunSpec) -> &'static [usize],
    says: impl Fn(&RunSpec) -> Says,
) {
    let path = root().join("experiments/reproduction.yaml");
    let experiment = spec::load(&path, &["vary={simulation.seed: [0, 1]}".into()], false).unwrap();
    for spec in experiment.runs() {
        if spec.latent().is_some_and(|latent| sizes(&spec).contains(&latent)) {
            finish_run(registry, "reproduction", &spec, says(&spec));
        }
    }
}

#[test]
fn claims_are_judged_by_readings_and_by_their_own_experiments() {
    let (folder, registry) = results(&[0, 1, 2], |_| Same);
    let sizes = |spec: &RunSpec| match spec.role() {
        Some("single_to_multi") => &[2, 4, 16][..],
        _ => &[16, 64, 128],
    };
    write_reproduction(&registry, sizes, |spec| match (spec.reading(), spec.role()) {
        (Some("recommended"), Some("multi_to_multi")) => Opposite,
        _ => Same,
    });
    let printed = succeed(folder.path(), &["claims", "--all"]);
    let header = printed.lines().find(|line| line.contains("condition")).unwrap();
    let at = ["base", "recommended", "own experiments"].map(|name| header.find(name).unwrap());
    assert!(at.is_sorted(), "{header}");
    let row = printed.split("──\n").find(|row| row.contains("vision_improves_force_r2")).unwrap();
    for (column, (start, end)) in
        [(at[0], at[1]), (at[1], at[2]), (at[2], usize::MAX)].into_iter().enumerate()
    {
        let cell = |line: &str| line.chars().take(end).skip(start).collect::<String>().trim().to_owned();
        let cells: Vec<String> = row.lines().map(cell).collect();
        let expected = if column == 1 { "does not hold" } else { "holds" };
        assert_eq!([&cells[1], &cells[3]], [expected; 2], "{row}");
        assert!(cells[0].ends_with(if column == 2 { ", n = 1" } else { ", n = 2" }), "{row}");
    }
    assert!(printed.lines().all(|line| line.chars().count() <= 186), "{printed}");
    assert_eq!(printed.matches("; intervals are 95 %").count(), 3, "{printed}");
    let one = succeed(folder.path(), &["claims", "vision_improves_force_r2"]);
    assert!(one.contains("\nrecommended:\nvision_improves_force_r2 empty: dataset 0 seed 0: 0.09"), "{one}");
    assert_eq!(one.matches("select scenario, seed,\n").count(), 1, "{one}");
    let csv = succeed(folder.path(), &["claims", "--format", "csv"]);
    assert!(csv.contains("\nrecommended,vision_improves_force_r2,"), "{csv}");
    assert!(csv.contains("\nown experiments,vision_improves_force_r2,"), "{csv}");
    // A choice of settings and a plan are about the claims' own experiments.
    let own = succeed(folder.path(), &["claims", "--all", "--where", "action=increment"]);
    assert!(own.contains("vision_improves_force_r2") && !own.contains("recommended"), "{own}");
    // Settings of the experiment with the readings choose among its runs.
    let first = succeed(folder.path(), &["claims", "--all", "--where", "reproduction:simulation.seed=0"]);
    let row = first.split("──\n").find(|row| row.contains("vision_improves_force_r2")).unwrap();
    assert!(row.contains("n = 1") && !row.contains("n = 2"), "{row}");
    // Without --all, the counts come first, and each claim has a line.
    let short = succeed(folder.path(), &["claims"]);
    assert!(short.starts_with("base: ") && short.lines().count() < 80, "{short}");
    let line = short.lines().find(|line| line.starts_with("vision_improves_force_r2 ")).unwrap();
    let words: Vec<&str> = line.split("  ").map(str::trim).filter(|word| !word.is_empty()).collect();
    assert_eq!(words[1..], ["holds", "does not hold", "holds"], "{short}");
    // A line about the columns.
    assert!(
        short.contains("\nbase: reproduction: ") && short.contains("own experiments: the experiments that"),
        "{short}"
    );
}

#[test]
fn no_run_is_added_to_published_results() {
    // There are no quick runs.
    let judged = succeed(&root().join("results/reference"), &["claims", "--quick", "forces_are_distal"]);
    let expected = "\nno run is added to published results; these commands make runs in the folder results\n\
                    for claims without data   harness run single_to_multi --quick\n";
    assert!(judged.contains(expected), "{judged}");
}

#[test]
fn settings_choose_among_the_runs_of_readings_if_there_are_no_others() {
    let folder = tempfile::tempdir().unwrap();
    let registry = Registry::new(folder.path());
    write_reproduction(&registry, |_| &[2, 4, 16], |_| Same);
    let base = succeed(folder.path(), &["claims", "--where", "reading=base"]);
    assert!(base.contains(" 0 do not hold") && !base.contains("recommended "), "{base}");
    let first = succeed(folder.path(), &["claims", "--all", "--where", "simulation.seed=0"]);
    assert!(first.contains("n = 1") && !first.contains("n = 2"), "{first}");
    // What is missing is a run of a reading.
    let plan = succeed(folder.path(), &["claims", "--plan"]);
    assert!(plan.contains(" run reproduction\n") && !plan.contains(" run multi_to_multi"), "{plan}");
}

#[test]
fn a_reading_without_runs_has_no_column() {
    let (folder, registry) = results(&[0, 1, 2], |_| Same);
    // On each dataset there is a network with vision of latent size 64. Another size was trained on one of them only.
    let sizes = |spec: &RunSpec| match (spec.reading(), spec.role(), spec.dataset_seed()) {
        (Some("base"), ..) => &[][..],
        (_, Some("single_to_multi"), _) => &[2, 4, 16],
        (.., 0) => &[16, 64],
        _ => &[64],
    };
    write_reproduction(&registry, sizes, |_| Same);
    let printed = succeed(folder.path(), &["claims", "--all"]);
    let header = printed.lines().find(|line| line.contains("condition")).unwrap();
    assert!(header.contains("recommended") && !header.contains("base"), "{header}");
    let csv = succeed(folder.path(), &["claims", "vision_improves_force_r2", "--format", "csv"]);
    let line = csv.lines().find(|line| line.starts_with("recommended,")).unwrap();
    assert!(line.ends_with(",holds"), "{line}");
}

// --- conditions and intervals ---

/// A judgment of values, without a requirement.
fn judgment(claim: &Claim, measured: Measured) -> Judgment<'_> {
    Judgment { claim, scenario: None, measured, required: None, mixed: Vec::new() }
}

/// Values of seeds on one dataset.
fn measured(values: &[f64]) -> Measured {
    let at = (0..).map(|seed| (0, seed));
    Measured { each: Each::Seed, values: at.zip(values.iter().copied()).collect(), minus: None }
}

#[test]
fn a_verdict_needs_the_whole_interval() {
    let text = "- {id: a, paper: p, section: s, measured: m, experiments: [single_to_multi], query: q, condition: \
                above 1}";
    let claims = load_text(text).unwrap();
    let verdict = |values: &[f64]| judgment(&claims[0], measured(values)).verdict();
    // Two values at a distance of d have the interval mean ± 12.71 d / 2, from a table of Student's t.
    assert_eq!(verdict(&[2.0, 2.1]), Verdict::Holds);
    assert_eq!(verdict(&[2.0, 2.2]), Verdict::Undecided);
    assert_eq!(verdict(&[0.2, 0.3]), Verdict::DoesNotHold);
    assert_eq!(verdict(&[1.0, 1.0]), Verdict::DoesNotHold);
    assert_eq!(verdict(&[1.5]), Verdict::OneValue { each: Each::Seed, satisfied: true });
    assert!(Condition::Below(0.5).satisfied_by(0.4) && !Condition::Below(0.5).satisfied_by(0.5));
}

#[test]
fn a_claim_of_no_advantage_is_judged_by_its_margin() {
    let text = "- {id: a, paper: p, section: s, measured: m, experiments: [single_to_multi], query: q, condition: \
                below margin 1}";
    let claims = load_text(text).unwrap();
    assert_eq!(claims[0].condition, Condition::Margin(1.0));
    let verdict = |values: &[f64]| judgment(&claims[0], measured(values)).verdict();
    // The half widths of the intervals are 12.71 times half of the distance.
    assert_eq!(verdict(&[0.0, 0.0]), Verdict::Holds, "equal networks");
    assert_eq!(verdict(&[0.2, 0.3]), Verdict::Holds, "an advantage that does not matter");
    assert_eq!(verdict(&[0.2, 0.4]), Verdict::Undecided);
    assert_eq!(verdict(&[1.7, 1.8]), Verdict::DoesNotHold);
    assert_eq!(verdict(&[-9.0, -8.9]), Verdict::Holds, "a disadvantage");
}

#[test]
fn a_difference_between_scenarios_is_not_paired() {
    let text = "- {id: a, paper: p, section: s, measured: m, experiments: [single_to_multi], query: q, condition: \
                above 0, difference: [cluttered, empty]}";
    let claims = load_text(text).unwrap();
    let of = |values: &[(u64, i64, f64)]| {
        values.iter().map(|(dataset, n, value)| ((*dataset, *n), *value)).collect()
    };
    let judged = |values: &[(u64, i64, f64)], minus: &[(u64, i64, f64)]| {
        judgment(&claims[0], Measured { each: Each::Episode, values: of(values), minus: Some(of(minus)) })
    };
    // The differences of episodes with the same number are all 1, but no episode has a partner in the other scenario.
    let large = [(0, 0, 2.0), (0, 1, 12.0), (0, 2, 22.0)];
    let small = [(0, 0, 1.0), (0, 1, 11.0), (0, 2, 21.0)];
    let one = judged(&large, &small);
    assert_eq!(one.verdict(), Verdict::Undecided);
    assert_eq!((one.interval().unwrap().mean, one.measured.count(), one.measured.datasets()), (1.0, 6, 1));
    // With several datasets, their means count: the episodes of each agree, but the datasets do not.
    let of_datasets = |values: [f64; 2]| {
        values.into_iter().zip(0..).flat_map(|(value, dataset)| [(dataset, 0, value), (dataset, 1, value)])
    };
    let several =
        judged(&of_datasets([1.0, 2.0]).collect::<Vec<_>>(), &of_datasets([0.0, 0.5]).collect::<Vec<_>>());
    assert_eq!((several.verdict(), several.measured.datasets()), (Verdict::Undecided, 2));
    let lone = judged(&of_datasets([1.0, 2.0]).collect::<Vec<_>>(), &small);
    assert_eq!(lone.verdict(), Verdict::OneValue { each: Each::Dataset, satisfied: false });
    assert_eq!(judged(&large, &[]).verdict(), Verdict::NoData);
}

#[test]
fn a_claim_is_testable_where_what_it_requires_holds() {
    let text =
        "- {id: a, paper: p, section: s, measured: m, experiments: [single_to_multi], query: q, condition: \
                above 1,
   requires: {measured: R2, query: r, condition: above 0.5}}";
    let claims = load_text(text).unwrap();
    let of = measured;
    let judged = |values: &[f64], required: &[f64]| {
        let required = Some(of(required));
        let claim = &claims[0];
        let judgment = Judgment { claim, scenario: None, measured: of(values), required, mixed: Vec::new() };
        (judgment.verdict(), judgment.unmet())
    };
    assert_eq!(judged(&[2.0, 2.1], &[0.9, 0.91]), (Verdict::Holds, None));
    assert_eq!(judged(&[0.2, 0.3], &[0.9, 0.91]), (Verdict::DoesNotHold, None));
    let unmet = |text: &str| (Verdict::NotTestable, Some(text.to_owned()));
    assert_eq!(judged(&[2.0, 2.1], &[0.4, 0.4]), unmet("R2: 0.4000, not above 0.5"));
    assert_eq!(judged(&[2.0, 2.1], &[0.4, 0.8]), unmet("R2: 0.6000 [-1.941, 3.141], not above 0.5"));
    assert_eq!(judged(&[2.0, 2.1], &[]), unmet("R2: no value, not above 0.5"));
    assert_eq!(judged(&[2.0], &[0.9]), (Verdict::OneValue { each: Each::Seed, satisfied: true }, None));
    assert_eq!(judged(&[2.0], &[0.4]), unmet("R2: 0.4000, not above 0.5"));
    assert_eq!(judged(&[], &[0.9]).0, Verdict::NoData);
}

#[test]
fn a_requirement_is_in_the_metric_of_the_claim_that_uses_it() {
    let sql = |id: &str| {
        let claim = CLAIMS.iter().find(|claim| claim.id() == id).unwrap();
        (claim.required_sql(false).unwrap(), claim.requires.as_ref().unwrap().measured.clone())
    };
    let simple =
        |error| format!("least(min(case when model in ('persistence', 'training_mean') then {error} end), ");
    for (id, metric, error, zero) in [
        ("fingertip_is_worst", "smape", "value", "100"),
        ("fingertip_is_worst_rmse", "rmse", "value", "null"),
        ("vision_improves_force", "wmape", "value", "100"),
        ("vision_improves_force_r2", "r2", "(1 - value)", "null"),
    ] {
        let (sql, measured) = sql(id);
        assert!(sql.contains(&format!("metric = '{metric}'")), "{sql}");
        assert!(sql.contains(&format!("{}{zero})", simple(error))), "{sql}");
        assert!(measured.contains(&format!(" in {metric} ")), "{measured}");
    }
}

#[test]
fn networks_that_a_simple_prediction_beats_decide_no_claim() {
    let (_folder, registry) = results(&[0, 1, 2], |_| Same);
    // With vision, the least WMAPE of the force is 20 % or 30 %. That of persistence is 65 %.
    let text = |metric: &str, beaten: &str| {
        format!(
            "- {{id: a, paper: p, section: s, measured: m, experiments: [multi_to_multi], metric: {metric}, query: \
             \"select seed, 1 as value from runs where latent = 64 and scenario = 'empty'\", condition: above 0, \
             requires: {{measured: m, condition: below 0.95, query: \"select seed, min(case when model = 'network' \
             then {{error}} end) / least(min(case when model = 'persistence' then {{error}} end), {{zero}}, {beaten}) \
             as value from metrics where metric = '{{metric}}' and modality = 'contact_force' and index is null and \
             direction is null and task = 'prediction' and scenario = 'empty' group by seed\"}}}}"
        )
    };
    for (metric, other, expected) in [
        ("wmape", "null", Verdict::Holds),
        ("wmape", "15", Verdict::NotTestable),
        ("r2", "null", Verdict::Holds),
        ("r2", "0.1", Verdict::NotTestable),
    ] {
        let claims = load_text(&text(metric, other)).unwrap();
        let analysis = runs(&registry, &[&claims[0]], &[], false).unwrap();
        let judged = judge(&analysis, &claims[0], false).unwrap();
        assert_eq!(judged[0].verdict(), expected, "{metric} {other}: {judged:?}");
    }
}

// --- the file ---

/// Loads the claims of a file with this text.
fn load_text(text: &str) -> Result<Vec<Claim>, String> {
    let (_folder, path) = file(text);
    let loaded = load(&path).map(|file| file.claims);
    loaded.map_err(|error| error.to_string().replace(path.to_str().unwrap(), "claims.yaml"))
}

fn file(text: &str) -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("claims.yaml");
    std::fs::write(&path, text).unwrap();
    (folder, path)
}

const ONE: &str = "- id: force
  paper: The force is predicted.
  section: IV-B
  measured: R2 of the contact force
  scenarios: [empty]
  experiments: [single_to_multi]
  query: |
    select scenario, seed, avg(value) as value from metrics group by scenario, seed
  condition: above 0.5
";

#[test]
fn faults_of_a_file_are_named_with_their_place() {
    assert!(load_text(ONE).is_ok());
    assert_eq!(load_text(&format!("readings: reproduction\nclaims:\n{ONE}")).unwrap().len(), 1);
    let error = load_text(&format!("reading: paper\nclaims:\n{ONE}")).unwrap_err();
    assert!(
        error.contains("1:1: unknown field `reading`, expected one of readings, with, claims"),
        "{error}"
    );
    let edited = |old: &str, new: &str| {
        assert!(ONE.contains(old));
        load_text(&ONE.replace(old, new)).unwrap_err()
    };
    let cases = [
        (edited("paper:", "papr:"), "2:3: unknown field `papr`, expected one of id, paper, statement, "),
        (
            edited("above 0.5", "over 0.5"),
            "9:14: 'over 0.5' is not a condition; write 'above NUMBER', 'below NUMBER' or 'below margin NUMBER' with a \
             margin above 0",
        ),
        (edited("above 0.5", "below margin 0"), "9:14: 'below margin 0' is not a condition; "),
        (
            edited("scenarios: [empty]", "difference: [empty, empty]"),
            "5:15: a difference is between two scenarios; write [cluttered, empty], for example",
        ),
        (
            edited("  scenarios", "  difference: [cluttered, empty]\n  scenarios"),
            "1:7: the claim 'force' has scenarios and a difference; leave out `scenarios`, which are judged one by one",
        ),
        (edited("above 0.5", "above inf"), "9:14: 'above inf' is not a condition; "),
        (edited("[empty]", "[my/robot.yaml]"), "5:15: 'my/robot.yaml' can't name a scenario"),
        (load_text(&[ONE, ONE].concat()).unwrap_err(), "10:7: there is a claim 'force' already"),
        (
            edited("  query", "  requires: {measured: m, query: q}\n  query"),
            "7:27: missing field `condition`",
        ),
        (
            edited("  query", "  metric: r2 box\n  query"),
            "7:11: 'r2 box' is no metric; the metrics are smape, wmape, r2, rmse, mae, relative_error, ",
        ),
        (
            edited("  query", "  metric: r2\n  query"),
            "7:11: no query of the claim 'force' contains {metric}; write metric = '{metric}'",
        ),
        (
            edited("avg(value)", "avg({error})"),
            "8:5: {error} stands for the metric of the claim 'force'; add the key `metric`, such as metric: r2",
        ),
        (
            edited(
                "  query: |\n    select scenario, seed, avg(value)",
                "  metric: wmape\n  requires: {measured: m, query: q, condition: above 0}\n  query: |\n    select \
                 scenario, seed, avg(case when metric = '{metric}' then value end)",
            ),
            "8:34: the claim 'force' has a metric, so its requirement must be in it; write metric = '{metric}'",
        ),
        (load_text("").unwrap_err(), "1:1: the file contains no claims"),
        (
            load_text("name: smoke\nlatent: [4]\n").unwrap_err(),
            "1:1: this is not a file of claims, which is a list, ",
        ),
        (
            load_text("- force\n- motion\n").unwrap_err(),
            "1:3: this is not a file of claims, which is a list, ",
        ),
        (load_text("- id: [\n").unwrap_err(), "1:7: broken YAML: unclosed bracket"),
    ];
    for (found, expected) in cases {
        assert!(found.starts_with(&format!("claims.yaml:{expected}")), "{found}");
    }
    assert!(edited("  condition: above 0.5\n", "").ends_with("missing field `condition`"));
}

#[test]
fn queries_can_read_the_queries_that_the_file_names() {
    let (folder, _) = results(&[0, 1], |_| Same);
    let named = "with:
  all_errors: select scenario, seed, value from best join two using (scenario, seed);
  best: select scenario, seed, min(value) as value from metrics where metric = 'rmse' group by scenario, seed
  two: select distinct scenario, seed from runs
claims:
";
    let queries = [
        "select scenario, seed, value from all_errors",
        "WITH own as (select * from all_errors)\n    select scenario, seed, value from own",
        "-- errors\n    with\n    own as (select * from ALL_ERRORS)\n    select scenario, seed, value from own",
        "select scenario, seed, min(value) as value from metrics where metric = 'rmse' and model <> 'best'\n    group by scenario, seed",
    ];
    for query in queries {
        let claim = ONE.replace(
            "select scenario, seed, avg(value) as value from metrics group by scenario, seed",
            query,
        );
        let (_file, path) = file(&format!("{named}{claim}"));
        let path = path.to_str().unwrap();
        let said = succeed(folder.path(), &["claims", "--file", path, "--format", "csv"]);
        assert!(said.contains("force,") && !said.contains("no data"), "{query}: {said}");
    }
    for (definition, message) in [
        ("v-x: select 1", "claims.yaml:2:8: 'v-x' under `with` is no name of a query"),
        ("runs: select 1", "claims.yaml:2:9: there is a table 'runs', which a query under `with` would hide"),
        ("best: selec value from runs", "claims.yaml:2:9: the query 'best' under `with`: "),
    ] {
        let error = load_text(&format!("with:\n  {definition}\nclaims:\n{ONE}")).unwrap_err();
        assert!(error.starts_with(message), "{error}");
    }
}

#[test]
fn the_message_about_other_files_names_each_claims_keys() {
    let message = load_text("name: smoke").unwrap_err();
    let named = message.rsplit_once("the keys ").unwrap().1.replace(" and ", ", ");
    let value = |key: &str| match key {
        "experiments" => "[single_to_multi]",
        "condition" => "above 0.5",
        _ => "text",
    };
    let claim_without = |other: &str| {
        let keys = named.split(", ").filter(|key| *key != other);
        format!("- {{{}}}", keys.map(|key| format!("{key}: {}", value(key))).collect::<Vec<_>>().join(", "))
    };
    assert!(load_text(&claim_without("nothing")).is_ok());
    for key in named.split(", ") {
        let error = load_text(&claim_without(key)).unwrap_err();
        assert!(error.ends_with(&format!("missing field `{key}`")), "{error}");
    }
}

#[test]
fn a_query_that_is_no_claims_query_is_refused_even_without_data() {
    let judged = |registry: &Registry, claims: &[Claim]| {
        let runs = runs(registry, &[&claims[0]], &[], false).unwrap();
        judge(&runs, &claims[0], false).unwrap_err().to_string()
    };
    let nowhere = Registry::new("/nonexistent");
    let cases = [
        ("select", "selct", "the query can't be answered: sql parser error: "),
        ("as value", "as val", "it gives the columns scenario, seed, val instead of scenario, seed, value"),
        (
            "select scenario, seed, avg(value)",
            "select seed, avg(value)",
            "it gives the columns seed, value instead of ",
        ),
    ];
    for (old, new, expected) in cases {
        assert!(ONE.contains(old));
        let claims = load_text(&ONE.replacen(old, new, 1)).unwrap();
        let error = judged(&nowhere, &claims);
        assert!(error.contains("claims.yaml:8:5: claim 'force': "), "{error}");
        assert!(error.contains(expected), "{error}");
    }
    // The requirement's query is checked in the same way. The error names the line of the query, not of an alias.
    let requiring = |id: &str, requires: &str| {
        ONE.replace("id: force", &format!("id: {id}"))
            .replace("  query", &format!("  requires: {requires}\n  query"))
    };
    let requirement =
        "&learned\n    measured: m\n    query: select seed, 1 as value from metrics\n    condition: above 0";
    let text = [requiring("a", requirement), requiring("b", "*learned")].concat();
    let claims = load_text(&text).unwrap();
    let runs_of_none = runs(&nowhere, &[&claims[1]], &[], false).unwrap();
    let error = judge(&runs_of_none, &claims[1], false).unwrap_err().to_string();
    assert!(
        error.contains("claims.yaml:9:12: claim 'b': it gives the columns seed, value instead of "),
        "{error}"
    );

    let (_folder, registry) = results(&[0], |_| Same);
    let claims =
        load_text(&ONE.replace("avg(value) as", "").replace(" group by scenario, seed", "")).unwrap();
    let error = judged(&registry, &claims);
    assert!(error.ends_with("it gives seed 0 several values; group by scenario and seed"), "{error}");
}

#[test]
fn the_claims_name_known_experiments_and_are_chosen_by_name() {
    for claim in CLAIMS.iter() {
        for name in &claim.experiments {
            assert!(claim.sql(false).contains(&format!("'{name}'")), "{}", claim.id());
            assert!(root().join(format!("experiments/{name}.yaml")).exists(), "{}", claim.id());
        }
        assert_eq!(choose(&CLAIMS, &[claim.id().to_owned()]).unwrap().len(), 1);
    }
    assert_eq!(choose(&CLAIMS, &[]).unwrap().len(), CLAIMS.len());
    let error = choose(&CLAIMS, &["vision_improves_forces".into()]).unwrap_err().to_string();
    let expected =
        "no claim is called 'vision_improves_forces'; did you mean 'vision_improves_force'? the claims are ";
    assert!(error.starts_with(expected), "{error}");
    assert!(CLAIMS.iter().all(|claim| error[expected.len()..].contains(claim.id())), "{error}");
}

#[test]
fn every_statement_of_the_paper_has_an_entry_or_a_reason() {
    let text = std::fs::read_to_string(root().join(FILE)).unwrap();
    let number = |line: &str| line.strip_prefix("# ")?.split_once('.')?.0.parse::<usize>().ok();
    let lines: Vec<&str> = text.lines().collect();
    let heads: Vec<usize> = (0..lines.len()).filter(|at| number(lines[*at]).is_some()).collect();
    assert_eq!(
        heads.iter().filter_map(|at| number(lines[*at])).collect::<Vec<_>>(),
        (1..=42).collect::<Vec<_>>()
    );
    let ends = heads.iter().skip(1).copied().chain([lines.len()]);
    for (&head, end) in heads.iter().zip(ends) {
        let has_entry = lines[head..end].iter().any(|line| line.starts_with("- id: "));
        assert_ne!(has_entry, lines[head].contains(". No entry: "), "{}", lines[head]);
    }
    let first = lines.iter().position(|line| line.starts_with("- id: ")).unwrap();
    assert!(heads[0] < first, "every entry belongs to a statement");
}

// --- claims about other runs ---

/// A claim about a robot of one's own: own names of experiments, scenarios, modalities, metrics.
const OWN: &str = "- id: boxes
  statement: The force on boxes is predicted.
  measured: R2 of the force on boxes
  scenarios: [maze, corridor]
  experiments: [my_robot]
  metric: r2_box
  requires:
    measured: error of the force in {metric} relative to the training mean
    query: |
      select scenario, seed, min(case when model = 'network' then {error} end)
                           / min(case when model = 'training_mean' then {error} end) as value
      from metrics
      where experiment = 'my_robot' and modality = 'grip' and metric = '{metric}'
      group by scenario, seed
    condition: below 0.95
  query: |
    select scenario, seed, max(case when model = 'network' then value end) as value
    from metrics
    where experiment = 'my_robot' and modality = 'grip' and metric = '{metric}'
    group by scenario, seed
  condition: above 0.5
";

/// The runs of an experiment of one's own, in two worlds of one's own, and a file of claims.
fn own_runs() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let registry = Registry::new(folder.path());
    let mut spec = experiment("single_to_multi", &[0]).runs().remove(0);
    for (scenario, r2) in [("maze", 0.8), ("corridor", 0.3)] {
        for seed in 0..3 {
            (spec.scenario, spec.seed) = (Scenario::new(scenario).unwrap().into(), seed);
            let mut made = Outcome { parameters: 1, ..Outcome::default() };
            for (model, value) in [("network", r2 + 1e-3 * seed as f64), ("training_mean", 0.0)] {
                let (modality, metric) = (Modality::new("grip").unwrap(), Metric::R2.in_region("box"));
                let row = Row {
                    modality,
                    direction: None,
                    index: None,
                    metric,
                    value: Some(value),
                    unit: String::new(),
                };
                made.metrics.push(MetricRow {
                    task: Task::Prediction,
                    model: model.to_owned(),
                    horizon: 1,
                    given: None,
                    row,
                });
            }
            let folder = registry.run("my_robot", &spec, &format!("{scenario}-made-up"));
            let run = registry.claim(&folder).unwrap().unwrap();
            let record = run.begin(&spec, &Layout::finger(), &Provenance::default()).unwrap();
            for task in &spec.tasks {
                std::fs::write(folder.checkpoint(*task), "made up").unwrap();
            }
            run.finish(record, &made).unwrap();
        }
    }
    std::fs::write(folder.path().join("own.yaml"), OWN).unwrap();
    folder
}

#[test]
fn claims_may_be_about_anybody_s_runs() {
    let folder = own_runs();
    let file = folder.path().join("own.yaml");
    let command = ["claims", "--file", file.to_str().unwrap()];
    let csv = succeed(folder.path(), &[&command[..], &["--format", "csv"]].concat());
    let verdict = |scenario: &str| {
        let line = csv.lines().find(|line| line.contains(&format!(",{scenario},")));
        line.unwrap_or_else(|| panic!("{csv}")).rsplit(',').next().unwrap().to_owned()
    };
    assert_eq!((verdict("maze").as_str(), verdict("corridor").as_str()), ("holds", "does not hold"));
    for format in ["text", "markdown", "latex", "csv", "json"] {
        let printed = succeed(folder.path(), &[&command[..], &["--format", format]].concat());
        assert!(printed.contains("datasets"), "{format}: {printed}");
    }
}

#[test]
fn a_name_that_no_run_has_is_named_with_those_that_there_are() {
    let folder = own_runs();
    let file = folder.path().join("own.yaml");
    let answer = |old: &str, new: &str| {
        assert!(OWN.contains(old));
        std::fs::write(&file, OWN.replace(old, new)).unwrap();
        finish(&mut harness(folder.path(), &["claims", "--file", file.to_str().unwrap()]))
    };
    let misspelled = answer("metric: r2_box", "metric: r2_bx");
    let expected = "own.yaml:6:11: claim 'boxes': no run has the metric 'r2_bx'; the runs have r2_box";
    assert!(misspelled.stdout.contains(expected), "{}", misspelled.stdout);
    let elsewhere = answer("[maze, corridor]", "[maze, coridor]");
    let expected = "no run of my_robot is in coridor; its runs are in corridor, maze";
    assert!(elsewhere.stdout.contains(expected), "{}", elsewhere.stdout);
}

// --- the command ---

#[test]
fn the_command_prints_every_claim_with_its_verdict() {
    let (folder, _registry) = results(&[0, 1, 2], |_| Same);
    let printed = succeed(folder.path(), &["claims", "--all"]);
    for claim in CLAIMS.iter() {
        assert!(printed.contains(claim.id()), "{} is not in {printed}", claim.id());
    }
    let all: usize = CLAIMS.iter().map(|claim| claim.scenarios.len().max(1)).sum();
    assert!(
        printed.ends_with(&format!(
            "{} hold, 0 do not hold, {OF_DATASETS} undecided, 0 not testable; intervals are 95 % over datasets or, \
             with one dataset, over seeds or episodes\n",
            all - OF_DATASETS
        )),
        "{printed}"
    );

    let one = succeed(folder.path(), &["claims", "force_errors_stay_high"]);
    assert!(one.contains("force_errors_stay_high empty: seed 0: -5.1"), "{one}");
    assert!(one.contains("force_errors_stay_high empty requires: seed 0: 0."), "{one}");
    assert!(
        one.contains(
            "select scenario, seed, least(min(case when model = 'persistence' then value end), 100)\n"
        ),
        "{one}"
    );
    assert!(one.contains("requires squared error of the joint angles or "), "{one}");

    let csv = folder.path().join("verdicts.csv");
    let said = succeed(folder.path(), &["claims", "--output", csv.to_str().unwrap()]);
    assert_eq!(said, format!("{all} verdicts in {}\n", csv.display()));
    let csv = std::fs::read_to_string(csv).unwrap();
    assert!(
        csv.starts_with(
            "claim,paper,section,measured,scenario,each,datasets,values,mean,low,high,condition,requires,required_mean,\
             required_low,required_high,required_condition,p,p_holm,verdict\n"
        ),
        "{csv}"
    );
    assert_eq!(csv.lines().filter(|line| line.ends_with(",holds")).count(), all - OF_DATASETS);
}

#[test]
fn the_command_says_why_a_claim_is_not_testable() {
    let (folder, _registry) = results(&[0, 1, 2], |_| Nothing);
    let printed =
        succeed(folder.path(), &["claims", "finger_motion_is_hardly_predicted", "arm_motion_is_predicted"]);
    let summary = "0 hold, 0 do not hold, 0 undecided, 2 not testable; ";
    assert!(printed.contains(summary), "{printed}");
    let reason = "not testable, cluttered   squared error of the frame difference relative to \"no change\", best \
                  latent size: 1.000 [";
    let line = printed.lines().find(|line| line.starts_with(reason)).unwrap_or_else(|| panic!("{printed}"));
    assert!(
        line.ends_with(", not below 0.95: arm_motion_is_predicted, finger_motion_is_hardly_predicted"),
        "{line}"
    );
}

#[test]
fn without_runs_the_command_says_which_to_make() {
    let nowhere = tempfile::tempdir().unwrap();
    std::fs::create_dir(nowhere.path().join("runs")).unwrap();
    let printed = succeed(nowhere.path(), &["claims", "--quick"]);
    for name in EXPERIMENTS {
        assert!(printed.contains(&format!(" run {name} --quick\n")), "{printed}");
    }
    let plan = succeed(nowhere.path(), &["claims", "--plan"]);
    assert!(plan.starts_with("there are no runs of the claims' own experiments\n"), "{plan}");
    for name in EXPERIMENTS {
        assert!(plan.contains(&format!(" run {name}\n")), "{plan}");
    }
    for (arguments, expected) in [
        (&["claims", "nope"][..], "error: no claim is called 'nope'; the claims are "),
        (&["claims", "--file", "nope.yaml"], "error: nope.yaml: there is no such file\n"),
    ] {
        let answer = finish(&mut harness(nowhere.path(), arguments));
        assert_eq!((answer.code, answer.stdout.as_str()), (2, ""));
        assert!(answer.stderr.starts_with(expected), "{}", answer.stderr);
    }
}
