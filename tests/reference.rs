//! The published results of the repository: intact, and enough for every figure, claim and query in the documents.

use crate::common::{ask, succeed};
use harness::figures::Figure;
use std::path::{Path, PathBuf};

fn reference() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("results/reference")
}

#[test]
fn published_results_are_whole_and_small() {
    let said = succeed(&reference(), &["verify"]);
    assert!(said.contains("all files are intact"), "{said}");
    fn bytes(folder: &Path) -> u64 {
        let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap());
        entries
            .map(
                |entry| {
                    if entry.path().is_dir() { bytes(&entry.path()) } else { entry.metadata().unwrap().len() }
                },
            )
            .sum()
    }
    assert!(bytes(&reference()) < 20_000_000);
    let files = glob::glob(reference().join("**/*").to_str().unwrap()).unwrap().map(Result::unwrap);
    assert!(files.filter(|path| path.is_file()).count() <= 200);
}

/// Every figure of the paper is there as a PNG, as `results/README.md` says how to draw it; those of tables are the
/// same bytes as drawn anew. What a driver renders may differ by machine.
#[test]
fn published_figures_are_those_of_the_published_tables() {
    let folder = tempfile::tempdir().unwrap();
    let draw = |more: &[&str], to: &str| {
        let out = folder.path().join(to);
        let arguments = [&["figures", "--format", "png", "--output", out.to_str().unwrap()], more].concat();
        succeed(&reference(), &arguments);
    };
    draw(&[], "");
    let pictures: Vec<(String, bool)> = Figure::OF_THE_PAPER
        .iter()
        .map(|figure| (format!("{}.png", figure.name()), figure.shows_runs()))
        .collect();
    assert_eq!(pictures.len(), 9);
    let mut bytes = 0;
    for (name, is_of_tables) in pictures {
        let published =
            std::fs::read(reference().join(&name)).unwrap_or_else(|_| panic!("there is no {name}"));
        let drawn = std::fs::read(folder.path().join(&name)).unwrap();
        let size = |bytes: &[u8]| {
            let picture = image::load_from_memory(bytes).unwrap();
            [picture.width(), picture.height()]
        };
        assert_eq!(size(&published), size(&drawn), "{name}");
        assert!((1000..9000).contains(&size(&published)[1]), "{name}: {:?}", size(&published));
        assert!(
            !is_of_tables || published == drawn,
            "{name} is not what `harness figures` draws of the tables"
        );
        assert!((10_000..500_000).contains(&published.len()), "{name}: {} bytes", published.len());
        bytes += published.len();
    }
    assert!(bytes < 2_000_000, "{bytes}");
}

/// Defaults may change, but the published runs must still match the data of their experiments.
#[test]
fn published_runs_are_of_the_data_that_their_experiments_name() {
    let mut found = 0;
    let records = harness::registry::Registry::new(reference()).records();
    for of_experiment in records.chunk_by(|a, b| a.experiment == b.experiment) {
        let name = &of_experiment[0].experiment;
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("experiments/{name}.yaml"));
        let runs = harness::spec::load(&path, &[], false).unwrap().runs();
        for record in of_experiment {
            let data = |run: &harness::spec::RunSpec| {
                (
                    run.scenario.clone(),
                    run.simulation.clone(),
                    run.split.clone(),
                    run.scalings(&harness::spec::Layout::finger()),
                )
            };
            let (label, task) = (record.spec.label(), record.spec.task_hash(&record.dataset));
            // A run of another model has the task of some run of the experiment.
            let is_it = |run: &&harness::spec::RunSpec| match record.spec.trained() {
                Some(_) => run.label() == label,
                None => run.task_hash(&record.dataset) == task,
            };
            let now = runs.iter().find(is_it).expect("the experiment has the run");
            assert_eq!(data(&record.spec), data(now), "{name}/{}", record.run);
            found += 1;
        }
    }
    assert!(found > 100, "{found}");
}

/// The commands in the head comments of `experiments/*.yaml`.
#[test]
fn commands_in_the_experiments_are_understood() {
    let mut commands = 0;
    for entry in std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("experiments")).unwrap() {
        let text = std::fs::read_to_string(entry.unwrap().path()).unwrap();
        for line in text.lines().filter_map(|line| line.strip_prefix('#')) {
            let line = line.trim_start().trim_start_matches("Command:").trim_start();
            let Some(command) = line.strip_prefix("harness ") else { continue };
            let command = command.split("  ").next().unwrap();
            // With --help, the program only reads the arguments before it.
            let words: Vec<&str> = command.split_whitespace().chain(["--help"]).collect();
            succeed(&reference(), &words);
            commands += 1;
        }
    }
    assert!(commands > 20, "{commands}");
}

/// All published runs can be made again from the commits that they name.
#[test]
fn published_runs_come_from_commits() {
    let rows = ask(&reference(), "select experiment, run from runs where git_dirty or git_commit is null");
    assert!(rows.is_empty(), "{rows:?}");
}

/// A validation error of 1 is that of the mean, or of no change for an image. The paper's recipe is published as it is.
/// Two numbers that are trained to predict forces do not reconstruct the angles, which docs/reproduction.md names.
#[test]
fn published_networks_have_learned_each_output() {
    let sql = "select experiment, run, task, term, min(value) as least from epochs where split = 'validation' and term \
               not in ('total', 'kl') and run not like '%reading=base%' and not (latent = 2 and \
               task = 'reconstruction') \
               group by all having min(value) > 0.95";
    let rows = ask(&reference(), sql);
    assert!(rows.is_empty(), "{rows:#?}");
}
