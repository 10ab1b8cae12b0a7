//! Every command that the program suggests works when it is pasted. In each situation, the tests collect all suggested
//! commands and run them in a shell.

use crate::common::{FAILING, SMOKE, finish, harness, smoke_run, succeed};
use harness::spec::SPECS;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;
use tempfile::TempDir;

/// Results that tests copy before they damage them.
static RESULTS: LazyLock<PathBuf> = LazyLock::new(|| smoke_run("suggestions"));

/// A results folder whose name must be quoted for a shell.
struct Situation {
    _folder: TempDir,
    results: PathBuf,
    said: String,
}

impl Situation {
    /// A folder with the results of the smoke experiment.
    fn new() -> Self {
        let situation = Self::without_runs();
        shell(&format!("cp -r {}/. {}", RESULTS.display(), shlex::try_quote(situation.name()).unwrap()));
        situation
    }

    fn without_runs() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let results = folder.path().join("it's all here");
        std::fs::create_dir_all(results.join("runs")).unwrap();
        Self { _folder: folder, results, said: String::new() }
    }

    fn name(&self) -> &str {
        self.results.to_str().unwrap()
    }

    /// The only folder in `below` whose name begins with `prefix`.
    fn folder(&self, below: &str, prefix: &str) -> PathBuf {
        let entries = std::fs::read_dir(self.results.join(below)).unwrap().map(|entry| entry.unwrap().path());
        let is_it = |path: &PathBuf| path.file_name().unwrap().to_string_lossy().starts_with(prefix);
        entries.filter(is_it).max().unwrap_or_else(|| panic!("there is no {below}/{prefix}…"))
    }

    fn run(&self, scenario: &str) -> PathBuf {
        self.folder("runs/smoke", scenario)
    }

    fn dataset(&self, scenario: &str) -> PathBuf {
        self.folder("datasets", scenario)
    }

    /// Runs a command, and keeps its output.
    fn say(&mut self, arguments: &[&str]) {
        let answer = finish(&mut harness(&self.results, arguments));
        self.said += &format!("{}{}", answer.stdout, answer.stderr);
    }

    /// Runs the commands that read all results.
    fn look(mut self) -> Self {
        for arguments in [
            &["verify"][..],
            &["ls"],
            &["query", "select count(run) from metrics"],
            &["query", "select count(sample) from episodes"],
            &["run", SMOKE, "--dry-run"],
        ] {
            self.say(arguments);
        }
        self
    }

    /// Runs every suggested command in a shell. There must be at least `least` of them.
    #[track_caller]
    fn works(&self, least: usize) {
        let commands = suggested(&self.said);
        assert!(commands.len() >= least, "only {commands:?} in\n{}", self.said);
        for command in commands {
            let is_about_results = !command.contains("harness schema");
            assert!(
                !is_about_results
                    || command.contains("it'\\''s all here")
                    || command.contains("it's all here"),
                "{command}"
            );
            // Other experiments take hours.
            let names = SPECS.iter().map(|spec| spec.name).filter(|name| *name != "smoke");
            let takes_hours = names.into_iter().any(|name| command.contains(&format!(" run {name}")));
            let code = shell(&if takes_hours { format!("{command} --dry-run") } else { command.clone() });
            // `verify` may find damage, and then exits with 1.
            assert!(code == 0 || command.ends_with(" verify") && code == 1, "{command} ends with {code}");
        }
    }
}

/// The commands in a text: those between backticks, after `repair:`, in HTML and at the end of a line.
pub fn suggested(text: &str) -> BTreeSet<String> {
    let mut commands = BTreeSet::new();
    let begins = |text: &str| ["harness ", "rm ", "mkdir "].iter().any(|begin| text.starts_with(begin));
    for line in text.lines() {
        let quoted = line.split('`').skip(1).step_by(2).filter(|quoted| quoted.starts_with("harness "));
        let aligned =
            ["repair: ", "next       ", "for claims without data   ", "continue with the same command: "];
        let aligned = aligned.iter().filter_map(|before| line.split_once(before)).map(|(_, command)| command);
        commands.extend(quoted.chain(aligned.filter(|command| begins(command))).map(str::to_owned));
        let html = line.split("<code>").skip(1).filter_map(|rest| rest.split_once("</code>"));
        let html =
            html.map(|(code, _)| code.replace("&#x2f;", "/").replace("&#x27;", "'").replace("&quot;", "\""));
        commands.extend(html.filter(|command| begins(command)));
    }
    commands
}

/// Runs a command in a shell, in the repository's root, and returns its exit code.
fn shell(command: &str) -> i32 {
    shell_in(Path::new(env!("CARGO_MANIFEST_DIR")), command)
}

/// Runs a command in a shell in this folder, and returns its exit code.
pub fn shell_in(folder: &Path, command: &str) -> i32 {
    let program = Path::new(env!("CARGO_BIN_EXE_harness")).parent().unwrap();
    let search = format!("{}:{}", program.display(), std::env::var("PATH").unwrap());
    let shell =
        Command::new("sh").args(["-c", command]).env("PATH", search).current_dir(folder).output().unwrap();
    shell.status.code().unwrap()
}

fn flip(path: &Path) {
    let mut bytes = std::fs::read(path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    std::fs::write(path, bytes).unwrap();
}

#[test]
fn what_is_suggested_after_a_run_works() {
    let mut situation = Situation::new();
    situation.say(&["run", SMOKE]);
    situation.works(1);
    let mut failed = Situation::without_runs();
    let answer = finish(&mut harness(&failed.results, &[&["run", SMOKE], &FAILING[..]].concat()));
    assert_eq!(answer.code, 1);
    failed.said = answer.stdout + &answer.stderr;
    failed.look().works(1);
}

/// A description of some damage, and a function that causes it.
type Damage<'a> = (&'a str, &'a dyn Fn(&Situation));

#[test]
fn what_is_suggested_for_damaged_runs_works() {
    let damages: [Damage; 8] = [
        ("a table", &|there| flip(&there.run("empty").join("metrics.parquet"))),
        ("a folder in the place of a table", &|there| {
            let table = there.run("empty").join("metrics.parquet");
            std::fs::remove_file(&table).unwrap();
            std::fs::create_dir_all(table.join("notes")).unwrap();
            // A run would find out after its training.
            let answer = finish(&mut harness(&there.results, &["run", SMOKE]));
            assert!(
                answer.stderr.contains("is damaged (a folder is in its place); `harness "),
                "{}",
                answer.stderr
            );
        }),
        ("no table", &|there| std::fs::remove_file(there.run("empty").join("metrics.parquet")).unwrap()),
        ("a record", &|there| flip(&there.run("empty").join("run.json"))),
        ("no record", &|there| std::fs::remove_file(there.run("empty").join("run.json")).unwrap()),
        ("a copied record", &|there| {
            std::fs::copy(there.run("empty").join("run.json"), there.run("cluttered").join("run.json"))
                .unwrap();
        }),
        ("a copied experiment", &|there| {
            let (from, to) = (there.results.join("runs/smoke"), there.results.join("runs/backup"));
            let words = [from, to].map(|path| path.to_str().unwrap().to_owned());
            shell(&format!("cp -r {}", shlex::try_join(words.iter().map(String::as_str)).unwrap()));
        }),
        ("a moved experiment", &|there| {
            std::fs::rename(there.results.join("runs/smoke"), there.results.join("runs/moved")).unwrap();
        }),
    ];
    for (what, damage) in damages {
        let there = Situation::new();
        damage(&there);
        let there = there.look();
        assert!(there.said.contains("repair: "), "{what}: {}", there.said);
        there.works(1);
        let healed = there.look();
        assert!(healed.said.contains("all files are intact"), "{what}: {}", healed.said);
    }
}

#[test]
fn a_damaged_run_is_repaired_once_its_spec_is_back() {
    let there = Situation::new();
    let (spec, elsewhere) = (there.results.join("lost.yaml"), there.results.join("elsewhere.yaml"));
    std::fs::copy(Path::new(env!("CARGO_MANIFEST_DIR")).join(SMOKE), &spec).unwrap();
    let arguments = ["run", spec.to_str().unwrap(), "name=lost", "scenarios=[empty]"];
    assert_eq!(finish(&mut harness(&there.results, &arguments)).code, 0);
    std::fs::rename(&spec, &elsewhere).unwrap();
    flip(&there.folder("runs/lost", "empty").join("epochs.parquet"));
    let there = there.look();
    for part in ["where it was run before; it fails here: ", "lost.yaml: there is no such file"] {
        assert!(there.said.contains(part), "{}", there.said);
    }
    assert!(!there.said.contains("rm -r"), "{}", there.said);
    std::fs::rename(&elsewhere, &spec).unwrap();
    let there = there.look();
    assert!(there.said.contains("repair: "), "{}", there.said);
    there.works(1);
    let healed = there.look();
    assert!(healed.said.contains("all files are intact"), "{}", healed.said);
}

#[test]
fn what_is_suggested_for_damaged_datasets_works() {
    let damages: [Damage; 7] = [
        ("an episode", &|there| flip(&there.dataset("empty").join("episode_00001.parquet"))),
        ("a folder in the place of an episode", &|there| {
            let episode = there.dataset("empty").join("episode_00001.parquet");
            std::fs::remove_file(&episode).unwrap();
            std::fs::create_dir(&episode).unwrap();
        }),
        ("no episode", &|there| {
            std::fs::remove_file(there.dataset("empty").join("episode_00001.parquet")).unwrap();
        }),
        ("no description", &|there| {
            std::fs::remove_file(there.dataset("empty").join("dataset.json")).unwrap()
        }),
        ("no dataset", &|there| std::fs::remove_dir_all(there.dataset("empty")).unwrap()),
        ("a moved dataset", &|there| {
            std::fs::remove_dir_all(there.results.join("runs/smoke")).unwrap();
            std::fs::rename(there.dataset("empty"), there.results.join("datasets/moved")).unwrap();
        }),
        ("a copied dataset", &|there| {
            let (from, to) = (there.dataset("empty"), there.results.join("datasets/a copy"));
            let words = [from, to].map(|path| path.to_str().unwrap().to_owned());
            shell(&format!("cp -r {}", shlex::try_join(words.iter().map(String::as_str)).unwrap()));
        }),
    ];
    for (what, damage) in damages {
        let there = Situation::new();
        damage(&there);
        let there = there.look();
        assert!(there.said.contains("repair: "), "{what}: {}", there.said);
        there.works(1);
        let healed = there.look();
        assert!(healed.said.contains("all files are intact"), "{what}: {}", healed.said);
    }
}

#[test]
fn what_is_suggested_where_nothing_is_found_works() {
    let mut there = Situation::new();
    there.say(&["show", "emptz"]);
    let empty = there.results.join("empty.yaml");
    std::fs::write(&empty, "").unwrap();
    there.say(&["validate", empty.to_str().unwrap()]);
    there.say(&["claims", "--plan"]);
    there.say(&["figures", "regression", "--quick"]);
    there.works(5);
    // No spec makes the runs of an experiment with this name.
    there.said.clear();
    there.say(&["figures", "regression", "--single", "nothing"]);
    assert!(
        there.said.ends_with("has no finished runs of nothing; those that have: smoke\n"),
        "{}",
        there.said
    );
    let claims = std::fs::read_to_string("experiments/claims.yaml").unwrap();
    let own = there.results.join("claims.yaml");
    std::fs::write(&own, claims.replace("[single_to_multi]", "[nothing]")).unwrap();
    there.say(&["claims", "--file", own.to_str().unwrap()]);
    assert!(
        there.said.contains("for claims without data   there is no spec called nothing\n"),
        "{}",
        there.said
    );
    there.works(1);
}

#[test]
fn what_is_suggested_for_a_folder_that_looks_like_an_option_works() {
    let folder = tempfile::tempdir().unwrap();
    let program = env!("CARGO_BIN_EXE_harness");
    let say = |arguments: &str| {
        let line = format!("{program} --results=-x {arguments} 2>&1");
        let output = Command::new("sh").args(["-c", &line]).current_dir(&folder).output().unwrap();
        String::from_utf8(output.stdout).unwrap()
    };
    let said = say("run smoke scenarios=empty tasks=prediction");
    std::fs::write(folder.path().join("-x/runs/stray"), "?").unwrap();
    let said = said + &say("verify") + &say("show emptz");
    let commands = suggested(&said);
    assert!(commands.len() >= 3, "{said}");
    for command in commands {
        assert_eq!(shell_in(folder.path(), &command), 0, "{command}");
    }
}

#[test]
fn the_tables_can_be_asked_for_as_is_suggested() {
    let there = Situation::new();
    let answer = finish(&mut harness(&there.results, &["query", "delete from runs"]));
    assert!(answer.stderr.contains("SHOW TABLES"), "{}", answer.stderr);
    let tables = succeed(&there.results, &["query", "show tables"]);
    for table in harness::schema::Table::ALL {
        assert!(tables.contains(table.name()), "{tables}");
    }
}
