//! The paper's claims, judged by tables that say what the paper says, and by tables that say the opposite.

mod common;

use common::{finish, harness, succeed};
use finger::JOINTS;
use harness::claims::{Claim, Condition, Each, Judgement, Measured, Verdict, choose, judge, load, runs};
use harness::learning::training::{Epoch, Losses, TOTAL};
use harness::metrics::contact::Contact;
use harness::metrics::{Direction, Metric, Row};
use harness::registry::{ForceRows, MetricRow, Outcome, Provenance, Registry};
use harness::seal;
use harness::spec::{self, Experiment, Layout, Modality, RunSpec, Scenario, Task};
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use std::sync::LazyLock;
use tempfile::TempDir;

#[path = "common/finger.rs"]
mod finger;

const FILE: &str = "experiments/claims.yaml";
const EXPERIMENTS: [&str; 2] = ["single_to_multi", "multi_to_multi"];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The claims that are checked in. Sameever a test says of claims, it says of all of them.
static CLAIMS: LazyLock<Vec<Claim>> = LazyLock::new(|| load(&root().join(FILE)).unwrap());

/// The paper's experiment with these seeds.
fn experiment(name: &str, seeds: &[u64]) -> Experiment {
    let path = root().join(format!("experiments/{name}.yaml"));
    spec::load(&path, &[format!("seeds={seeds:?}")], false).unwrap()
}

// --- tables that agree with the paper, and tables that don't ---

/// What a run says beside the paper.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Says {
    Same,
    Opposite,
}
use Says::{Opposite, Same};

/// Where a run stands.
#[derive(Clone, Copy)]
struct Place {
    vision: bool,
    cluttered: bool,
    /// 0 for the smallest of the experiment's latent sizes, 1 for the middle, 2 for the largest.
    size: usize,
}

impl Place {
    fn of(spec: &RunSpec, experiment: &Experiment) -> Self {
        Self {
            vision: spec.input.contains(&Modality::VISION),
            cluttered: spec.scenario == Scenario::CLUTTERED.into(),
            size: experiment.latent.iter().position(|latent| *latent == spec.latent).unwrap(),
        }
    }
}

/// An error between 0 and 1 that is least where the paper says that it is least.
fn error(
    place: Place,
    task: Task,
    modality: Modality,
    direction: Option<Direction>,
    index: Option<u32>,
) -> f64 {
    let Place { vision, cluttered, size } = place;
    let overall = match (task, modality, vision) {
        (Task::Prediction, Modality::PROPRIOCEPTION, false) if cluttered => [0.6, 0.6, 0.5][size],
        (Task::Prediction, Modality::PROPRIOCEPTION, false) => [0.5, 0.5, 0.6][size],
        (Task::Prediction, Modality::PROPRIOCEPTION, true) => [0.2, 0.1, 0.2][size],
        (Task::Prediction, Modality::CONTACT_FORCE, false) => 0.7,
        (Task::Prediction, Modality::CONTACT_FORCE, true) if cluttered => [0.4, 0.3, 0.2][size],
        (Task::Prediction, Modality::CONTACT_FORCE, true) => [0.3, 0.2, 0.3][size],
        (Task::Reconstruction, Modality::PROPRIOCEPTION, false) => [0.5, 0.4, 0.5][size],
        (Task::Reconstruction, Modality::PROPRIOCEPTION, true) => [0.3, 0.3, 0.2][size],
        _ => 0.5,
    };
    // Lateral angles are easier, lateral forces harder.
    let harder = match modality {
        Modality::PROPRIOCEPTION => Direction::FLEXION_EXTENSION,
        _ => Direction::ADDUCTION_ABDUCTION,
    };
    let by_direction = match direction {
        None => 0.0,
        Some(direction) if direction == harder => 0.02,
        Some(_) => -0.02,
    };
    let fingertip = index.is_some_and(|index| index as usize >= JOINTS - 2);
    overall + by_direction + if fingertip { 0.05 } else { 0.0 }
}

/// The relative errors of the frame difference on the arm and on the finger.
fn part_errors(place: Place) -> [f64; 2] {
    [0.2, [0.85, 0.9, 0.9][place.size]]
}

/// The epoch of the best validation loss.
fn best_epoch(place: Place) -> usize {
    match place {
        Place { vision: true, size, .. } => [40, 25, 10][size],
        Place { cluttered: true, size, .. } => [40, 40, 10][size],
        Place { cluttered: false, size, .. } => [40, 10, 40][size],
    }
}

/// The mean force on each link, N.
fn forces(says: Says, cluttered: bool) -> [f64; JOINTS] {
    let [proximal, distal] = match (says, cluttered) {
        (Same, false) => [0.1, 2.0],
        (Same, true) => [0.5, 3.0],
        (Opposite, false) => [2.0, 0.1],
        (Opposite, true) => [1.0, 0.5],
    };
    std::array::from_fn(|link| if link < 15 { proximal } else { distal })
}

/// What a run would leave that finds what `says` says: every number of the opposite mirrors the paper's.
fn outcome(says: Says, spec: &RunSpec, experiment: &Experiment) -> Outcome {
    let place = Place::of(spec, experiment);
    let mirrored = |value: f64, around: f64| if says == Same { value } else { around - value };
    // Seeds and sizes differ by a little, as those of real runs.
    let noise = 1e-3 * ((spec.seed * 7 + spec.latent as u64 * 3) % 5) as f64;
    let mut metrics = Vec::new();
    let mut push = |task, modality, direction, index, metric, value| {
        let row = Row { modality, direction, index, metric, value: Some(value), unit: String::new() };
        metrics.push(MetricRow { task, model: "network", row });
    };
    for (task, modalities) in [(Task::Prediction, &spec.output), (Task::Reconstruction, &spec.input)] {
        for &modality in modalities {
            let joints =
                (0..JOINTS as u32).map(|index| (Some(Direction::FINGER[index as usize % 2]), Some(index)));
            let directions = Direction::FINGER.map(|direction| (Some(direction), None));
            let groups = [(None, None)].into_iter().chain(directions).chain(joints);
            for (direction, index) in groups.filter(|_| !Layout::finger()[modality].is_image()) {
                let error = mirrored(error(place, task, modality, direction, index), 1.0) + noise;
                for metric in [Metric::Smape, Metric::Wmape, Metric::Rmse, Metric::R2] {
                    let value = match metric {
                        Metric::R2 => 1.0 - error,
                        Metric::Rmse => error,
                        _ => 100.0 * error,
                    };
                    push(task, modality, direction, index, metric, value);
                }
            }
            if modality == Modality::FRAME_DIFFERENCE {
                let [arm, finger] = part_errors(place).map(|error| mirrored(error, 1.0) + noise);
                push(task, modality, None, None, Metric::of_region("arm"), arm);
                push(task, modality, None, None, Metric::of_region("finger"), finger);
            }
        }
    }
    let best = mirrored(best_epoch(place) as f64, 50.0) + spec.seed as f64;
    let epoch = |epoch: usize| {
        let losses = Losses::from([(TOTAL.to_owned(), 1.0 + (epoch as f64 - best).abs())]);
        (Task::Prediction, Epoch { epoch, train: losses.clone(), validation: losses, seconds: 1.0 })
    };
    let contact = |mean: f64| Contact { samples: 1000, contacts: 500, mean, quantiles: None, max: None };
    let forces = (0..4).map(|episode| {
        let force = |force: f64| contact(force * (1.0 + 0.01 * f64::from(episode)));
        let links = forces(says, place.cluttered).map(force).to_vec();
        ForceRows { modality: Modality::CONTACT_FORCE, episode: Some(episode), links }
    });
    Outcome { epochs: (1..=60).map(epoch).collect(), metrics, forces: forces.collect(), ..Outcome::default() }
}

/// Writes an experiment's runs with these seeds, each saying what `says` of its seed.
fn write(registry: &Registry, name: &str, seeds: &[u64], says: impl Fn(u64) -> Says) {
    let experiment = experiment(name, seeds);
    for spec in experiment.runs() {
        finish_run(registry, &experiment, &spec, says(spec.seed));
    }
}

/// Writes one run.
fn finish_run(registry: &Registry, experiment: &Experiment, spec: &RunSpec, says: Says) {
    let folder = registry.run(&experiment.name, spec, &format!("{}-made-up", spec.scenario));
    let record = registry.begin(&folder, spec, &Layout::finger(), &Provenance::default()).unwrap();
    // Claims read tables alone; the record wants the networks too.
    for task in &spec.tasks {
        std::fs::write(folder.checkpoint(*task), "made up").unwrap();
    }
    registry.finish(&folder, record, &outcome(says, spec, experiment)).unwrap();
}

/// A results folder with both experiments.
fn results(seeds: &[u64], says: impl Fn(u64) -> Says) -> (TempDir, Registry) {
    let folder = tempfile::tempdir().unwrap();
    let registry = Registry::new(folder.path());
    EXPERIMENTS.iter().for_each(|name| write(&registry, name, seeds, &says));
    (folder, registry)
}

/// Every claim judged, one judgement a scenario.
fn judgements(registry: &Registry, quick: bool) -> Vec<Judgement<'static>> {
    let claims: Vec<&'static Claim> = CLAIMS.iter().collect();
    let runs = runs(registry, &claims, &[], quick).unwrap();
    claims.into_iter().flat_map(|claim| judge(&runs, claim, quick).unwrap()).collect()
}

#[track_caller]
fn assert_verdicts(registry: &Registry, expected: impl Fn(&Judgement) -> Verdict) {
    for judgement in judgements(registry, false) {
        let Judgement { claim, scenario, measured, .. } = &judgement;
        let found = judgement.verdict();
        assert_eq!(found, expected(&judgement), "{} {scenario:?}: {measured:?}", claim.id());
    }
}

fn about_the_dataset(judgement: &Judgement) -> bool {
    judgement.measured.each == Each::Episode
}

// --- verdicts ---

#[test]
fn every_claim_holds_where_the_tables_agree_with_the_paper() {
    let (_folder, registry) = results(&[0, 1, 2], |_| Same);
    assert_verdicts(&registry, |_| Verdict::Holds);
}

#[test]
fn no_claim_holds_where_the_tables_say_the_opposite() {
    let (_folder, registry) = results(&[0, 1, 2], |_| Opposite);
    assert_verdicts(&registry, |_| Verdict::DoesNotHold);
}

#[test]
fn claims_are_undecided_where_seeds_disagree() {
    let (_folder, registry) = results(&[0, 1, 2, 3], |seed| if seed % 2 == 0 { Same } else { Opposite });
    for judgement in judgements(&registry, false).iter().filter(|judgement| !about_the_dataset(judgement)) {
        assert_eq!(judgement.verdict(), Verdict::Undecided, "{}", judgement.claim.id());
        let Measured { each: Each::Seed, values } = &judgement.measured else { panic!("{judgement:?}") };
        assert_eq!(values.keys().copied().collect::<Vec<_>>(), [0, 1, 2, 3]);
    }
}

#[test]
fn a_single_seed_decides_nothing_but_shows_where_it_points() {
    for (says, satisfied, dataset) in [(Same, true, Verdict::Holds), (Opposite, false, Verdict::DoesNotHold)]
    {
        let (_folder, registry) = results(&[7], |_| says);
        assert_verdicts(&registry, |judgement| {
            if about_the_dataset(judgement) { dataset } else { Verdict::OneSeed { satisfied } }
        });
    }
}

#[test]
fn claims_without_their_runs_are_undecided() {
    let folder = tempfile::tempdir().unwrap();
    let registry = Registry::new(folder.path());
    assert_verdicts(&registry, |_| Verdict::NoData);
    write(&registry, "single_to_multi", &[0, 1, 2], |_| Same);
    assert_verdicts(&registry, |judgement| {
        let needs_vision = judgement.claim.experiments.iter().any(|name| name == "multi_to_multi");
        if needs_vision { Verdict::NoData } else { Verdict::Holds }
    });
}

#[test]
fn a_seed_counts_only_when_all_its_runs_are_there() {
    let (_folder, registry) = results(&[0, 1, 2], |_| Same);
    // A fourth seed of which only the smallest latent size is done.
    for name in EXPERIMENTS {
        let mut experiment = experiment(name, &[9]);
        let all = experiment.clone();
        experiment.latent.truncate(1);
        for spec in experiment.runs() {
            finish_run(&registry, &all, &spec, Opposite);
        }
    }
    for judgement in judgements(&registry, false).iter().filter(|judgement| !about_the_dataset(judgement)) {
        let Measured { each: Each::Seed, values } = &judgement.measured else { panic!("{judgement:?}") };
        // What is asked of the smallest size alone has its fourth seed.
        let alone = judgement.claim.sql(false).contains("latent = 2 ");
        assert_eq!(values.len(), if alone { 4 } else { 3 }, "{}", judgement.claim.id());
    }
}

#[test]
fn runs_of_other_settings_are_refused_and_chosen_by_name() {
    let (folder, registry) = results(&[0, 1, 2], |_| Same);
    let mut other = experiment("single_to_multi", &[0, 1, 2]);
    other.training.batch_size = 16;
    for spec in other.runs().into_iter().take(5) {
        finish_run(&registry, &other, &spec, Opposite);
    }
    let reads_it = |claim: &Claim| claim.experiments.iter().any(|name| name == "single_to_multi");
    assert_verdicts(
        &registry,
        |judgement| {
            if reads_it(judgement.claim) { Verdict::Mixed } else { Verdict::Holds }
        },
    );
    let refused = "the runs of single_to_multi differ in training.batch_size (16, 1024); choose some, as with \
                   `--where 'single_to_multi:training.batch_size=1024'`\n";
    let printed = succeed(folder.path(), &["claims"]);
    assert!(printed.contains("settings differ") && printed.contains(refused), "{printed}");
    // What the message says works, as it stands there.
    let option = ["--where", "single_to_multi:training.batch_size=1024"];
    let chosen = succeed(folder.path(), &[&["claims"][..], &option].concat());
    assert!(chosen.contains(" 0 do not hold, 0 undecided; "), "{chosen}");
    // Only five runs have the other batch size, too few for any claim but those about forces.
    let option = ["--where", "single_to_multi:training.batch_size=16"];
    let chosen = succeed(folder.path(), &[&["claims", "force_errors_stay_high"][..], &option].concat());
    assert!(chosen.contains("undecided: no data"), "{chosen}");
}

#[test]
fn a_variant_is_a_setting_that_a_query_may_tell_apart() {
    let folder = tempfile::tempdir().unwrap();
    let registry = Registry::new(folder.path());
    let mut sweep = experiment("single_to_multi", &[0, 1]);
    sweep.vary = [("training.kl_weight".to_owned(), vec![0.0.into(), 0.5.into()])].into();
    for spec in sweep.runs() {
        finish_run(&registry, &sweep, &spec, Same);
    }
    assert!(judgements(&registry, false).iter().all(|judgement| {
        let reads_it = judgement.claim.experiments.iter().any(|name| name == "single_to_multi");
        judgement.verdict() == if reads_it { Verdict::Mixed } else { Verdict::NoData }
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

#[test]
fn runs_of_an_older_method_are_left_out() {
    let (_folder, registry) = results(&[0, 1], |_| Opposite);
    // As an older version would have named their folders.
    for name in EXPERIMENTS {
        for entry in std::fs::read_dir(registry.root().join("runs").join(name)).unwrap() {
            age(&entry.unwrap().path());
        }
    }
    // They count where there are no others.
    assert_verdicts(&registry, |_| Verdict::DoesNotHold);
    EXPERIMENTS.iter().for_each(|name| write(&registry, name, &[0, 1], |_| Same));
    assert_verdicts(&registry, |_| Verdict::Holds);
}

/// Makes a run one of the revision before this one.
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
        let experiment = experiment(name, &[0, 1]);
        for spec in experiment.runs() {
            let folder = registry.run(&format!("{name}-quick"), &spec, "made-up");
            let record = registry.begin(&folder, &spec, &Layout::finger(), &Provenance::default()).unwrap();
            // Claims read tables alone; the record wants the networks too.
            for task in &spec.tasks {
                std::fs::write(folder.checkpoint(*task), "made up").unwrap();
            }
            registry.finish(&folder, record, &outcome(Same, &spec, &experiment)).unwrap();
        }
    }
    assert_verdicts(&registry, |_| Verdict::NoData);
    for judgement in judgements(&registry, true) {
        assert_eq!(judgement.verdict(), Verdict::Holds, "{}", judgement.claim.id());
    }
}

// --- conditions and intervals ---

#[test]
fn a_verdict_needs_the_whole_interval() {
    let text = "- {id: a, paper: p, section: s, measured: m, experiments: [single_to_multi], query: q, condition: above 1}";
    let claims = load_text(text).unwrap();
    let verdict = |values: &[f64]| {
        let measured = Measured { each: Each::Seed, values: (0..).zip(values.iter().copied()).collect() };
        Judgement { claim: &claims[0], scenario: None, measured, mixed: Vec::new() }.verdict()
    };
    // Two values at a distance of d have the interval mean ± 12.71 d / 2, from a table of Student's t.
    assert_eq!(verdict(&[2.0, 2.1]), Verdict::Holds);
    assert_eq!(verdict(&[2.0, 2.2]), Verdict::Undecided);
    assert_eq!(verdict(&[0.2, 0.3]), Verdict::DoesNotHold);
    assert_eq!(verdict(&[1.0, 1.0]), Verdict::DoesNotHold);
    assert_eq!(verdict(&[1.5]), Verdict::OneSeed { satisfied: true });
    assert!(Condition::Below(0.5).satisfied_by(0.4) && !Condition::Below(0.5).satisfied_by(0.5));
}

// --- the file ---

/// The claims of a file with this text.
fn load_text(text: &str) -> Result<Vec<Claim>, String> {
    let (_folder, path) = file(text);
    load(&path).map_err(|error| error.to_string().replace(path.to_str().unwrap(), "claims.yaml"))
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
    let edited = |old: &str, new: &str| {
        assert!(ONE.contains(old));
        load_text(&ONE.replace(old, new)).unwrap_err()
    };
    let cases = [
        (edited("paper:", "papr:"), "2:3: unknown field `papr`, expected one of id, paper, "),
        (
            edited("above 0.5", "over 0.5"),
            "9:14: 'over 0.5' is no condition; write 'above NUMBER' or 'below NUMBER'",
        ),
        (edited("above 0.5", "above inf"), "9:14: 'above inf' is no condition; "),
        (edited("[empty]", "[emty]"), "5:14: unknown scenario `emty`, expected one of empty, cluttered"),
        (load_text(&[ONE, ONE].concat()).unwrap_err(), "10:7: there is a claim 'force' already"),
        (load_text("").unwrap_err(), "1:1: the file holds no claims"),
    ];
    for (found, expected) in cases {
        assert!(found.starts_with(&format!("claims.yaml:{expected}")), "{found}");
    }
    assert!(edited("  condition: above 0.5\n", "").ends_with("missing field `condition`"));
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
        assert!(error.starts_with("claim 'force', query at line "), "{error}");
        assert!(error.contains(expected), "{error}");
    }
    let (_folder, registry) = results(&[0], |_| Same);
    let claims =
        load_text(&ONE.replace("avg(value) as", "").replace(" group by scenario, seed", "")).unwrap();
    let error = judged(&registry, &claims);
    assert!(error.ends_with("it gives seed 0 several values; group by scenario and seed"), "{error}");
}

#[test]
fn the_checked_in_claims_name_experiments_that_exist_and_are_chosen_by_name() {
    for claim in CLAIMS.iter() {
        for name in &claim.experiments {
            assert!(claim.sql(false).contains(&format!("'{name}'")), "{}", claim.id());
            assert!(root().join(format!("experiments/{name}.yaml")).exists(), "{}", claim.id());
        }
        assert_eq!(choose(&CLAIMS, &[claim.id().to_owned()]).unwrap().len(), 1);
    }
    assert_eq!(choose(&CLAIMS, &[]).unwrap().len(), CLAIMS.len());
    let error = choose(&CLAIMS, &["vision_improves_forces".into()]).unwrap_err().to_string();
    assert_eq!(error, "no claim is called 'vision_improves_forces'; did you mean 'vision_improves_force'?");
}

// --- the command ---

#[test]
fn the_command_prints_every_claim_with_its_verdict() {
    let (folder, _registry) = results(&[0, 1, 2], |_| Same);
    let printed = succeed(folder.path(), &["claims"]);
    for claim in CLAIMS.iter() {
        assert!(printed.contains(claim.id()), "{} is not in {printed}", claim.id());
    }
    let all: usize = CLAIMS.iter().map(|claim| claim.scenarios.len().max(1)).sum();
    assert!(
        printed.ends_with(&format!(
            "{all} hold, 0 do not hold, 0 undecided; intervals are 95 % over seeds (forces: episodes)\n"
        )),
        "{printed}"
    );

    let one = succeed(folder.path(), &["claims", "force_errors_stay_high"]);
    assert!(one.contains("force_errors_stay_high empty: seed 0: 70."), "{one}");
    assert!(one.contains("select scenario, seed, min(value) as value"), "{one}");

    let csv = folder.path().join("verdicts.csv");
    let said = succeed(folder.path(), &["claims", "--output", csv.to_str().unwrap()]);
    assert_eq!(said, format!("{all} verdicts in {}\n", csv.display()));
    let csv = std::fs::read_to_string(csv).unwrap();
    assert!(
        csv.starts_with(
            "claim,paper,section,measured,scenario,each,values,mean,low,high,condition,verdict\n"
        ),
        "{csv}"
    );
    assert_eq!(csv.lines().filter(|line| line.ends_with(",holds")).count(), all);
}

#[test]
fn without_runs_the_command_says_which_to_make() {
    let nowhere = tempfile::tempdir().unwrap();
    std::fs::create_dir(nowhere.path().join("runs")).unwrap();
    let printed = succeed(nowhere.path(), &["claims", "--quick"]);
    for name in EXPERIMENTS {
        assert!(printed.contains(&format!(" run experiments/{name}.yaml --quick\n")), "{printed}");
    }
    for (arguments, expected) in [
        (&["claims", "nope"][..], "error: no claim is called 'nope'; did you mean '"),
        (&["claims", "--file", "nope.yaml"], "error: nope.yaml: there is no such file\n"),
    ] {
        let answer = finish(&mut harness(nowhere.path(), arguments));
        assert_eq!((answer.code, answer.stdout.as_str()), (2, ""));
        assert!(answer.stderr.starts_with(expected), "{}", answer.stderr);
    }
}
