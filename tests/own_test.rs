//! Runs whose test has a dataset of its own: every command knows both datasets.

use crate::common::{SMOKE, ask, finish, fresh, harness, succeed};
use harness::dataset::AnyDataset;
use harness::experiment::rollout;
use harness::registry::{Registry, RunRecord};
use harness::spec::Modality;
use std::collections::BTreeSet;
use std::path::Path;

const SPEC: [&str; 5] =
    [SMOKE, "scenarios=[empty]", "test.episodes=2", "vary={simulation.seed: [0, 1]}", "tasks=[prediction]"];

fn with<'a>(command: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    [&[command], &SPEC[..], more].concat()
}

fn records(results: &Path) -> Vec<RunRecord> {
    Registry::new(results).recorded().into_iter().map(|(_, record)| record).collect()
}

#[test]
fn runs_on_several_datasets_share_one_test() {
    let results = fresh("own-test");
    let planned = succeed(&results, &with("run", &["--dry-run"]));
    assert!(planned.contains("for test, 0 of 2 episodes made"), "{planned}");
    assert_eq!(planned.matches("for training and validation, 0 of 4 episodes made").count(), 2, "{planned}");
    succeed(&results, &with("collect", &["--shard", "1/2"]));
    let said = succeed(&results, &with("run", &[]));
    assert!(said.contains("2 done, 0 done before, 0 failed"), "{said}");
    assert!(succeed(&results, &with("run", &[])).contains("0 done, 2 done before, 0 failed"));

    let records = records(&results);
    let tests: BTreeSet<&str> = records.iter().map(|record| record.tested()).collect();
    let all: BTreeSet<&str> =
        records.iter().flat_map(|record| record.datasets()).map(|(name, _)| name).collect();
    assert_eq!((records.len(), tests.len(), all.len()), (2, 1, 3));
    let test = *tests.first().unwrap();
    let rows = ask(&results, "select distinct run, episode from predictions order by run, episode");
    let episodes: Vec<u64> = rows.iter().map(|row| row["episode"].as_u64().unwrap()).collect();
    assert_eq!(episodes, [0, 1, 0, 1]);
    // The predicted values are those of the test's dataset.
    let joined = "select count(*) as n, sum(case when p.reference = e.contact_force_19 then 1 else 0 end) as same \
         from predictions p join runs r on p.run = r.run \
         join episodes e on e.dataset = r.test_dataset and e.episode = p.episode and e.sample = p.sample \
         where p.modality = 'contact_force' and p.\"index\" = 19";
    let row = &ask(&results, joined)[0];
    assert!(row["n"].as_u64().unwrap() > 0);
    assert_eq!(row["n"], row["same"]);

    // What does not depend on the training is the same for both runs.
    let of_persistence = "select modality, direction, \"index\", min(value) as low, max(value) as high from metrics \
                          where model = 'persistence' and metric = 'rmse' group by modality, direction, \"index\"";
    let rows = ask(&results, of_persistence);
    assert!(!rows.is_empty() && rows.iter().all(|row| row["low"] == row["high"]), "{rows:?}");

    // The sums of the episodes are those of the metrics.
    let sums = "select s.model, s.modality, s.direction, s.metric, count(*) as episodes, max(m.value) as value, \
                sum(numerator) / sum(denominator) as ratio from sums s join metrics m on s.run = m.run \
                and s.model = m.model and s.modality = m.modality and s.metric = m.metric and m.\"index\" is null \
                and s.direction is not distinct from m.direction \
                where s.metric in ('mae', 'r2') group by s.run, s.model, s.modality, s.direction, s.metric";
    let rows = ask(&results, sums);
    assert_eq!(rows.len(), 2 * (11 + 8), "{rows:?}");
    for row in rows {
        let ratio = row["ratio"].as_f64().unwrap_or(f64::NAN);
        let metric = if row["metric"] == "r2" { 1.0 - ratio } else { ratio };
        let value = row["value"].as_f64();
        assert!(
            row["episodes"] == 2
                && value.is_none_or(|value| (value - metric).abs() < 1e-3 * (1.0 + value.abs())),
            "{row:?}"
        );
    }

    let said = |arguments: &[&str]| {
        let text = succeed(&results, &[&["compare"], arguments].concat());
        text.split_whitespace().collect::<Vec<_>>().join(" ")
    };
    let note = "runs in a world share their test episodes, and the intervals";
    let compared = said(&[]);
    assert!(compared.contains("interval over 2 datasets and 2 test episodes"), "{compared}");
    assert!(!compared.contains(note), "{compared}");
    let compared = said(&["--metrics", "r2,kl"]);
    assert!(compared.contains(&format!("{note} of kl are those on these episodes")), "{compared}");
    let one_more = said(&["--interval", "next-dataset"]);
    assert!(one_more.contains("prediction interval for one more dataset, from 2 datasets"), "{one_more}");
    assert!(one_more.contains(&format!("{note} are those on these episodes")), "{one_more}");
    let half = |model: &str, arguments: &[&str]| -> Vec<f64> {
        let path = results.join("means.json");
        succeed(&results, &[&["compare", "--output", path.to_str().unwrap()], arguments].concat());
        let rows: Vec<serde_json::Value> = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
        let half = |row: &serde_json::Value| row["high"].as_f64().unwrap() - row["mean"].as_f64().unwrap();
        rows.iter().filter(|row| row["model"] == model).map(half).collect()
    };
    // With two datasets, the prediction interval is √(2 + 1) times as wide as one over datasets alone.
    let [mean, next] =
        ["mean", "next-dataset"].map(|over| half("network", &["--metrics=kl", "--interval", over])[0]);
    assert!((next - mean * 3.0_f64.sqrt()).abs() < 1e-9 * next, "{mean} {next}");
    // Persistence is the same on both datasets, so only the episodes vary, also in differences.
    let of_persistence = half("persistence", &["--metrics=mae"]);
    assert!(of_persistence.len() == 3 && of_persistence.iter().all(|half| *half > 0.0), "{of_persistence:?}");
    let differences = half("network", &["--metrics=mae", "--against", "persistence"]);
    assert!(differences.iter().all(|half| *half > 0.0), "{differences:?}");

    assert_eq!(succeed(&results, &["gc", "--yes"]), "nothing to remove\n");
    succeed(&results, &["verify"]);
    let other = fresh("own-test-copied");
    succeed(&results, &["publish", "smoke", "--complete", "--output", other.to_str().unwrap()]);
    assert!(other.join("datasets").join(test).join("episode_00001.parquet").is_file());
    let rollout = rollout(&Registry::new(&results), &records[0].run, None, 1).unwrap();
    let dataset = AnyDataset::at(&results.join("datasets").join(test)).unwrap();
    let first = dataset.load_episode(0).unwrap();
    assert_eq!(rollout.episode, 0);
    assert_eq!(rollout.samples.vectors(Modality::SETPOINT), first.vectors(Modality::SETPOINT));

    let (output, model) = ("output=[proprioception,contact_force]", ["--model", "mujoco"]);
    let judge = [&["judge", SMOKE, "simulator", output][..], &SPEC[1..3], &model].concat();
    let said = succeed(&results, &judge);
    assert!(said.contains("mujoco"), "{said}");

    std::fs::remove_file(results.join("datasets").join(test).join("episode_00001.parquet")).unwrap();
    let answer = finish(&mut harness(&results, &["verify"]));
    assert!(answer.code != 0 && answer.stdout.contains(test), "{}", answer.stdout);
    succeed(&results, &with("collect", &[]));
    succeed(&results, &["verify"]);
}

#[test]
fn a_test_has_factors_of_its_own() {
    let results = fresh("own-test-factors");
    let spec = ["run", SMOKE, SPEC[1], SPEC[2], SPEC[4]];
    let vectors = ["input=[proprioception]", "output=[proprioception,contact_force]"];
    let run = |name: &str, more: &[&str]| {
        succeed(&results, &[&spec[..], &vectors, &[&format!("name={name}")], more].concat());
        let sql = format!(
            "select value from metrics where experiment = '{name}' and model = 'persistence' and metric = 'rmse' and \
             modality = 'contact_force' and \"index\" is null"
        );
        let value = ask(&results, &sql)[0]["value"].as_f64().unwrap();
        let record = records(&results).into_iter().find(|record| record.experiment == name).unwrap();
        (value, record.tested().to_owned())
    };
    let plain = run("plain", &[]);
    let softer = run("softer", &["test.factors=[finger_stiffness]"]);
    // Trained with a factor, and tested without it, on the same test as the first run.
    let varied = run("varied", &["simulation.factors=[finger_friction]", "test.factors=[]"]);
    assert_eq!(varied, plain);
    assert!(softer.0 != plain.0 && softer.1 != plain.1, "{softer:?} {plain:?}");
    let wrong = finish(&mut harness(&results, &[&spec[..], &["test.factors=[stiffness]"]].concat()));
    assert!(wrong.stderr.contains("unknown factor 'stiffness' in 'test.factors'"), "{}", wrong.stderr);
    assert!(wrong.stderr.contains("finger_stiffness") && wrong.code == 2, "{}", wrong.stderr);
}

/// The empty world with another model.
struct Soft(tempfile::TempDir);

impl Soft {
    fn new(stiffness: &str) -> Self {
        let soft = Self(tempfile::tempdir().unwrap());
        let world = include_str!("../models/empty.yaml").replace("model: empty.xml", "model: soft.xml");
        std::fs::write(soft.path(), world).unwrap();
        soft.set(stiffness);
        soft
    }

    fn path(&self) -> std::path::PathBuf {
        self.0.path().join("soft.yaml")
    }

    fn set(&self, stiffness: &str) {
        let (model, own) = (include_str!("../models/empty.xml"), "joint stiffness=\"20\"");
        assert!(model.contains(own));
        let model = model.replace(own, &format!("joint stiffness=\"{stiffness}\""));
        std::fs::write(self.0.path().join("soft.xml"), model).unwrap();
    }
}

#[test]
fn a_network_is_tested_in_other_worlds_than_its_own() {
    let results = fresh("own-test-worlds");
    let soft = Soft::new("5");
    let varied = format!("vary={{test.world: [empty, cluttered, {}]}}", soft.path().display());
    let vectors = ["input=[proprioception]", "output=[proprioception,contact_force]"];
    let spec = [&SPEC[..3], &SPEC[4..], &vectors].concat();
    let run = |verb: &'static str, more: &[&str]| {
        [&[verb], &spec[..], more].concat().iter().map(|word| word.to_string()).collect::<Vec<_>>()
    };
    let said = |words: Vec<String>| succeed(&results, &words.iter().map(String::as_str).collect::<Vec<_>>());
    said(run("run", &["name=plain"]));
    let planned = said(run("run", &["name=shifted", &varied, "--dry-run"]));
    assert!(
        planned.contains("world=soft") && planned.contains("for test, 0 of 2 episodes made"),
        "{planned}"
    );
    said(run("collect", &["name=shifted", &varied]));
    said(run("run", &["name=shifted", &varied]));
    assert!(said(run("run", &["name=shifted", &varied])).contains("0 done, 3 done before, 0 failed"));

    let all = records(&results);
    let of = |world: &str| {
        let is_it =
            |record: &&RunRecord| record.experiment == "shifted" && record.spec.tested_in().name() == world;
        all.iter().find(is_it).unwrap()
    };
    let plain = all.iter().find(|record| record.experiment == "plain").unwrap();
    // The training does not depend on the test: its weights are the same to the bit.
    let weights = |record: &RunRecord| record.files["prediction.safetensors"].sha256.clone();
    let tested = [of("empty"), of("cluttered"), of("soft")];
    assert!(tested.iter().all(|record| weights(record) == weights(plain)));
    assert!(tested.iter().all(|record| record.dataset == plain.dataset));
    assert_eq!(of("empty").tested(), plain.tested());
    assert!(of("cluttered").tested().starts_with("cluttered-") && of("soft").tested().starts_with("soft-"));
    let metrics = |record: &RunRecord, model: &str| {
        let sql = format!(
            "select modality, direction, metric, \"index\", value from metrics where experiment = '{}' and run = '{}' \
             and model = '{model}' order by modality, direction, metric, \"index\"",
            record.experiment, record.run
        );
        ask(&results, &sql)
    };
    for model in ["network", "persistence", "ridge", "training_mean"] {
        assert!(!metrics(plain, model).is_empty());
        assert_eq!(metrics(of("empty"), model), metrics(plain, model), "{model}");
        let [empty, cluttered, soft] = tested.map(|record| metrics(record, model));
        assert!(empty != cluttered && empty != soft && soft != cluttered, "{model}");
    }
    // Kinds of contact are those of the test.
    let kinds = |world: &str| {
        let rows = metrics(of(world), "network");
        let has = |kind: &str| rows.iter().any(|row| row["metric"].as_str().unwrap().ends_with(kind));
        (has("_ground"), has("_box"))
    };
    assert_eq!(
        [kinds("empty"), kinds("cluttered"), kinds("soft")],
        [(true, false), (true, true), (true, false)]
    );
    // The predicted values are those of the test's dataset.
    let joined = "select r.run, count(*) as n, sum(case when p.reference = e.contact_force_19 then 1 else 0 end) as same \
         from predictions p join runs r on p.run = r.run and p.experiment = r.experiment \
         join episodes e on e.dataset = r.test_dataset and e.episode = p.episode and e.sample = p.sample \
         where p.modality = 'contact_force' and p.\"index\" = 19 group by r.run";
    let rows = ask(&results, joined);
    assert_eq!(rows.len(), 4);
    assert!(rows.iter().all(|row| row["n"].as_u64().unwrap() > 0 && row["n"] == row["same"]), "{rows:?}");
    let shown = succeed(&results, &["compare", "shifted", "--by", "test.world", "--metrics", "r2"]);
    assert!(["empty", "cluttered", "soft"].iter().all(|world| shown.contains(world)), "{shown}");
    assert!(!shown.contains("left out"), "{shown}");

    assert_eq!(succeed(&results, &["gc", "--yes"]), "nothing to remove\n");
    succeed(&results, &["verify"]);
    let rollout = rollout(&Registry::new(&results), &of("cluttered").run, None, 1).unwrap();
    assert_eq!(rollout.record.tested(), of("cluttered").tested());
    // The simulator goes on from the states of the test, in the world of the test.
    let judge =
        [&["judge", SMOKE, "simulator"], &spec[1..], &["test.world=cluttered", "--model", "mujoco"]].concat();
    assert!(succeed(&results, &judge).contains("mujoco"));

    // Results of before and after a change of the test's world are never averaged.
    soft.set("10");
    let again = said(run("run", &["name=shifted", &varied]));
    assert!(again.contains("1 done, 2 done before, 0 failed"), "{again}");
    let counted = finish(&mut harness(&results, &["compare", "shifted"]));
    assert!(
        counted.stderr.contains("1 finished run in other versions of the world soft"),
        "{}",
        counted.stderr
    );
    let verified = finish(&mut harness(&results, &["verify"]));
    assert_eq!(verified.code, 0, "{}", verified.stdout);
    succeed(&results, &["gc", "--only", "world", "--yes"]);
    let left = records(&results).iter().filter(|record| record.experiment == "shifted").count();
    assert_eq!(left, 3);
}

#[test]
fn a_world_that_records_something_else_is_no_test() {
    let results = fresh("own-test-other-layout");
    let soft = Soft::new("5");
    let refusal = |from: &str, to: &str| {
        let text = std::fs::read_to_string(soft.path()).unwrap();
        assert!(text.contains(from), "{from}");
        std::fs::write(soft.path(), text.replacen(from, to, 1)).unwrap();
        let world = format!("test.world={}", soft.path().display());
        let vectors = ["input=[proprioception]", "output=[proprioception,contact_force]"];
        let words = [&["run"], &SPEC[..3], &vectors, &[&*world]].concat();
        let answer = finish(&mut harness(&results, &words));
        std::fs::write(soft.path(), text).unwrap();
        assert_eq!(answer.code, 2, "{}", answer.stderr);
        assert_eq!(answer.stderr.trim_end().lines().count(), 1, "{}", answer.stderr);
        answer.stderr
    };
    let said = refusal("finger_joint_*", "finger_joint_0*");
    assert!(said.contains("has 10 values instead of 20, so it can't be the test"), "{said}");
    assert!(said.contains("in the same way in the worlds empty and soft, or change test.world"), "{said}");
    let said = refusal("unit: m, range", "unit: mm, range");
    assert!(said.contains("of setpoint of soft-") && said.contains("'mm' instead of"), "{said}");
    let said = refusal("  contact_force:\n", "  contact_strength:\n");
    assert!(said.contains("the world soft has no 'contact_force', which the runs use"), "{said}");
    let said = refusal("sample_rate_hz: 10", "sample_rate_hz: 20");
    assert!(said.contains("different defaults for 'simulation.sample_rate_hz'; give it a value"), "{said}");
    assert!(!results.join("runs").exists());
}
