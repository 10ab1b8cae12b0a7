//! Hostile input: nothing that is read panics, hangs, takes much memory or writes outside the results folder.
//!
//! Each reader gets input that an attacker would write, and random mutations of good input. `cargo test` tries a few
//! thousand mutations. `cargo test --test all hostile:: -- --ignored --nocapture` tries mutations for `SOAK_SECONDS`
//! (default: 600) per reader, or only for the reader `SOAK_READER`.

use crate::common::{SMOKE, finish, harness};
use harness::catalog::query;
use harness::learning::tensors::TensorFile;
use harness::registry::Registry;
use harness::schema::Table;
use harness::spec::{Experiment, SpecError, parse_spec};
use harness::tables::{Stamp, TableFile, write_table};
use polars::prelude::*;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::HashMap;
use std::path::Path;
use std::sync::LazyLock;
use std::time::{Duration, Instant};

/// A time limit that no refusal reaches, even on a busy machine.
const SOON: Duration = Duration::from_secs(60);

static TABLE: LazyLock<Vec<u8>> = LazyLock::new(a_table);
static SMOKE_TEXT: LazyLock<String> = LazyLock::new(|| read(SMOKE));

fn read(path: &str) -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).unwrap()
}

fn parse(text: &str, overrides: &[String]) -> Result<Experiment, SpecError> {
    let begin = Instant::now();
    let parsed = parse_spec("hostile.yaml", text, overrides, false);
    assert!(begin.elapsed() < SOON, "took {:?}", begin.elapsed());
    parsed
}

#[track_caller]
fn refused(text: &str, overrides: &[String], expected: &str) {
    let message = parse(text, overrides).unwrap_err().to_string();
    assert!(message.contains(expected), "{message}");
    assert!(message.len() < 2000, "{} bytes of message", message.len());
    assert!(!message.contains('\n') && !message.contains('\0'), "{message:?}");
}

// --- specs ---

#[test]
fn names_that_leave_the_results_folder_are_refused() {
    let long = "n".repeat(65);
    for name in ["../up", "/etc/cron.d/x", "a/b", ".", "..", "a\\b", "nul\\0", "naïve", "a b", "", &long] {
        let text = SMOKE_TEXT.replacen("name: smoke", &format!("name: \"{name}\""), 1);
        assert!(parse(&text, &[]).is_err(), "{name} is no name of a folder");
        assert!(parse(&SMOKE_TEXT, &[format!("name=\"{name}\"")]).is_err(), "{name} is no name of a folder");
    }
    refused(&SMOKE_TEXT, &["name=../up".into()], "can't name a folder");
    refused(&SMOKE_TEXT, &["name=\"a\\0b\"".into()], "can't name a folder");
}

#[test]
fn a_bomb_of_aliases_is_refused() {
    let mut bomb = "a: &a [x,x,x,x,x,x,x,x,x]\n".to_owned();
    for (this, last) in ('b'..='i').zip('a'..='h') {
        bomb += &format!(
            "{this}: &{this} [*{last},*{last},*{last},*{last},*{last},*{last},*{last},*{last},*{last}]\n"
        );
    }
    refused(&bomb, &[], "broken YAML");
    refused("a: &a [*a]", &[], "broken YAML");
    refused(&format!("{}\nb: *missing", *SMOKE_TEXT), &[], "broken YAML");
}

#[test]
fn deep_and_endless_structures_are_refused() {
    for open in ["[", "{a: ", "- ", "? ", "!!seq [", "&a ["] {
        for depth in [100, 100_000] {
            assert!(parse(&open.repeat(depth), &[]).is_err(), "{depth} times '{open}'");
        }
    }
    refused(&"[".repeat(1 << 19), &[], "broken YAML");
    refused(&SMOKE_TEXT, &[format!("latent={}", "[".repeat(100_000))], "broken YAML");
    refused(&SMOKE_TEXT, &[format!("latent=[{}]", "1,".repeat(1 << 20))], "larger than 1 MiB");
}

#[test]
fn lists_and_bounds_that_make_too_many_runs_are_refused() {
    let list = |numbers: std::ops::Range<u32>| {
        numbers.map(|number| number.to_string()).collect::<Vec<_>>().join(",")
    };
    let override_with = |key: &str, numbers| format!("{key}=[{}]", list(numbers));
    refused(&SMOKE_TEXT, &[override_with("seeds", 0..140_000)], "broken YAML");
    refused(&SMOKE_TEXT, &[override_with("latent", 1..90_000)], "'latent': expected an integer");
    refused(&SMOKE_TEXT, &[override_with("seeds", 0..90_000)], "make 180000 runs, more than the 10000");
    refused(
        &SMOKE_TEXT,
        &[override_with("latent", 1..500), override_with("seeds", 0..500)],
        "2 scenarios, 499 latent sizes and 500 seeds make 499000 runs",
    );
    let twice = format!("seeds=[{},0]", list(0..90_000));
    refused(&SMOKE_TEXT, &[twice], "0 is in 'seeds' twice");
    assert_eq!(parse(&SMOKE_TEXT, &[override_with("seeds", 0..5000)]).unwrap().runs().len(), 10_000);
}

#[test]
fn numbers_out_of_all_bounds_are_refused() {
    for number in ["1e400", "-1e400", ".nan", ".inf", "1e-400", "-1", "0x7fffffffffffffff", "0"] {
        for key in ["training.learning_rate", "training.epochs", "simulation.sample_rate_hz"] {
            assert!(parse(&SMOKE_TEXT, &[format!("{key}={number}")]).is_err(), "{key}={number}");
        }
    }
    for number in
        ["340282366920938463463374607431768211456", "99999999999999999999", "-170141183460469231731687"]
    {
        assert!(parse(&SMOKE_TEXT, &[format!("simulation.seed={number}")]).is_err(), "{number}");
    }
    let most = ["simulation.episodes=1000000", "simulation.actuations_per_episode=100000"];
    refused(&SMOKE_TEXT, &most.map(String::from), "samples a scenario are more than");
}

#[test]
fn endless_words_are_refused_in_few() {
    let word = "w".repeat(1 << 19);
    refused(&format!("{word}: 1"), &[], "broken YAML");
    let word = "w".repeat(1000);
    refused(&format!("{word}: 1"), &[], "unknown key 'wwww");
    let word = "w".repeat(1 << 19);
    refused(&format!("? {word}\n: 1"), &[], "unknown key 'wwww");
    refused(&SMOKE_TEXT.replacen("[empty, cluttered]", &format!("[{word}]"), 1), &[], "unknown");
    refused(&SMOKE_TEXT, &[format!("{word}=1")], "unknown key 'wwww");
    refused(&SMOKE_TEXT, &[format!("training.epochs={word}")], "found the text 'wwww");
    refused(&SMOKE_TEXT, &[format!("quick={{{word}: 1}}")], "unknown key 'quick'");
    refused(&format!("{}quick:\n  ? {word}\n  : 1\n", *SMOKE_TEXT), &[], "unknown key 'wwww");
}

#[test]
fn a_spec_that_never_ends_is_not_read_to_its_end() {
    let folder = tempfile::tempdir().unwrap();
    let results = folder.path().join("results");
    let answer = finish(&mut harness(&results, &["validate", "/dev/zero"]));
    assert_eq!(answer.code, 2);
    assert!(answer.stderr.contains("/dev/zero: is larger than 1 MiB"), "{}", answer.stderr);
    assert!(!results.exists());
}

// --- queries ---

#[track_caller]
fn question_refused(sql: &str, expected: &str) {
    let begin = Instant::now();
    let message = query(&Registry::new("/nonexistent"), sql).unwrap_err().to_string();
    assert!(begin.elapsed() < SOON, "took {:?}", begin.elapsed());
    assert!(message.contains(expected), "{message}");
}

#[test]
fn a_query_reads_the_tables_alone() {
    let folder = tempfile::tempdir().unwrap();
    let secret = folder.path().join("secret.csv");
    std::fs::write(&secret, "word\nhush\n").unwrap();
    let secret = secret.display();
    for sql in [
        format!("select * from read_csv('{secret}')"),
        format!("select * from Read_CSV('{secret}') as metrics"),
        format!("select * from \"read_csv\"('{secret}')"),
        format!("with a as (select * from read_csv('{secret}')) select * from a"),
        format!("select * from runs where run in (select word from read_csv('{secret}'))"),
        format!("select * from runs join (select * from read_csv('{secret}')) as b on runs.run = b.word"),
        format!("select (select word from read_csv('{secret}')) as word from runs"),
        format!("select run from runs union all select word from read_csv('{secret}')"),
        format!("explain select * from read_csv('{secret}')"),
        "select * from read_parquet('/*/*.parquet')".into(),
    ] {
        question_refused(&sql, "is not a table, and other files can't be read");
    }
    for sql in [format!("select * from '{secret}'"), format!("select * from \"{secret}\"")] {
        question_refused(&sql, "");
    }
    let text = query(&Registry::new("/nonexistent"), "select 'read_csv(''x'')' as text from runs").unwrap();
    assert_eq!(text.height(), 0, "a text is a text");
}

#[test]
fn a_query_changes_nothing() {
    for sql in [
        "create table x as select * from runs",
        "drop table runs",
        "truncate table runs",
        "delete from runs",
        "insert into runs values (1)",
        "update runs set run = ''",
        "copy runs to 'x.csv'",
        "explain delete from runs",
        "attach 'x' as y",
        "set a = 1",
    ] {
        question_refused(sql, "is not a query");
    }
    question_refused("select 1; drop table runs", "it has 2 statements instead of one");
    question_refused("", "it has 0 statements instead of one");
}

#[test]
fn queries_that_nest_or_never_end_are_refused() {
    let chain = |word: &str, joint: &str| format!("select {} from runs", vec![word; 4000].join(joint));
    question_refused(&chain("1", "+"), "nested more than 200 levels deep");
    question_refused(&chain("seed = 1", " or "), "tokens, but at most");
    question_refused(&chain("1", "::"), "");
    question_refused(
        &format!("select 1{} from runs", "::int".repeat(4000)),
        "nested more than 200 levels deep",
    );
    question_refused(
        &format!("select {}1{}", "(".repeat(4000), ")".repeat(4000)),
        "are nested too deeply; use WITH",
    );
    for function in
        ["substr(", "cast(", "not(", "array[", "date(", "position(", "extract(day from ", "case when ("]
    {
        for depth in [8, 12, 20, 49] {
            let sql = format!("select {}x y", function.repeat(depth));
            question_refused(&sql, "");
        }
    }
    let nested = format!("select {}run{} from runs", "upper(lower(".repeat(4), "))".repeat(4));
    query(&Registry::new("/nonexistent"), &nested).unwrap();
    let subqueries = "select run from (select run from (select run from (select run from runs)))";
    query(&Registry::new("/nonexistent"), subqueries).unwrap();

    question_refused(&format!("select {}", "a,".repeat(10_000)), "tokens, but at most 20000 are allowed");
    question_refused(&format!("select '{}'", "x".repeat(10 << 20)), "bytes, but at most 1048576 are allowed");
    let between = " between 2 and 8".repeat(20);
    question_refused(
        &format!("select run from runs where latent{between}"),
        "BETWEEN, CASE or IN are nested too deeply",
    );
    let case =
        (0..10).fold("seed".to_owned(), |inner, _| format!("case {inner} when 1 then 2 when 2 then 3 end"));
    question_refused(&format!("select {case} from runs"), "BETWEEN, CASE or IN are nested too deeply");
    let sums = format!("select {} from runs", vec!["seed"; 190].join("+"));
    query(&Registry::new("/nonexistent"), &sums).unwrap();
    let whens = |count: usize| format!("select case {} end from runs", "when seed = 1 then 2 ".repeat(count));
    query(&Registry::new("/nonexistent"), &whens(190)).unwrap();
    question_refused(&whens(300), "nested more than 200 levels deep");
    let greatest = format!("select greatest({}) from runs", vec!["seed"; 1000].join(","));
    query(&Registry::new("/nonexistent"), &greatest).unwrap();
    let list = (0..9000).map(|seed| seed.to_string()).collect::<Vec<_>>().join(",");
    query(&Registry::new("/nonexistent"), &format!("select run from runs where seed in ({list})")).unwrap();
}

#[test]
fn a_query_of_what_is_not_supported_is_refused_in_one_line() {
    let results = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("results/reference");
    for sql in [
        "select interval '1 t' as a from runs",
        "select x'ff' from runs",
        "select a[1] from runs",
        "select :a",
    ] {
        let answer = finish(&mut harness(&results, &["query", sql]));
        assert_eq!(answer.code, 2);
        assert!(answer.stderr.starts_with("error: the query can't be answered: "), "{}", answer.stderr);
        assert_eq!(answer.stderr.lines().count(), 1, "{}", answer.stderr);
    }
}

// --- mutations of good input ---

/// A function that reads mutated input. It must return without a panic.
struct Reader {
    name: &'static str,
    corpus: Vec<Vec<u8>>,
    /// Words of the input's language, which are inserted at random places.
    words: &'static [&'static str],
    read: fn(&[u8]),
}

fn readers() -> Vec<Reader> {
    let specs =
        ["smoke", "multi_to_multi", "single_to_multi"].map(|name| read(&format!("experiments/{name}.yaml")));
    vec![
        Reader {
            name: "spec",
            corpus: specs.iter().map(|text| text.clone().into_bytes()).collect(),
            words: YAML_WORDS,
            read: |bytes| {
                let Ok(text) = std::str::from_utf8(bytes) else { return };
                check_experiment(parse(text, &[]));
            },
        },
        Reader {
            name: "overrides",
            corpus: [
                "training.epochs=3\nlatent=[8,16]",
                "training.loss_weights={vision: 0.5}\nsplit.test=1e-1\nname='x'",
                "simulation.lift_range_m=[-1, 0]\ntasks=[prediction]\ntraining.patience=null",
            ]
            .map(|text| text.as_bytes().to_vec())
            .to_vec(),
            words: YAML_WORDS,
            read: |bytes| {
                let Ok(text) = std::str::from_utf8(bytes) else { return };
                let overrides: Vec<String> = text.lines().map(str::to_owned).collect();
                check_experiment(parse(&SMOKE_TEXT, &overrides));
            },
        },
        Reader {
            name: "sql",
            corpus: [
                "select scenario, latent, avg(value) as wmape from metrics where task = 'prediction' and \
                 index is null group by scenario, latent having count(*) > 0 order by wmape desc limit 3",
                "with a as (select run, max(epoch) as last from epochs group by run) select runs.run, a.last \
                 from runs left join a on runs.run = a.run where runs.latent between 2 and 8",
                "select case when seed % 2 = 0 then 'even' else upper(run) end as kind, \
                 row_number() over (partition by scenario order by seed) from runs union all select run, 1 from runs",
                "select cast(round(reference) as int), round(predicted, 2), substr(run, 1, 3) || 'x', \
                 sum(predicted) over (partition by run order by sample) from predictions where modality like \
                 'contact%' or episode in (1, 2, 3)",
            ]
            .map(|text| text.as_bytes().to_vec())
            .to_vec(),
            words: SQL_WORDS,
            read: |bytes| {
                let Ok(text) = std::str::from_utf8(bytes) else { return };
                let _ = query(&Registry::new("/nonexistent"), text);
            },
        },
        Reader {
            name: "tensors",
            corpus: vec![a_tensor_file()],
            words: &["F32", "U8", "\"shape\":[", "data_offsets", "18446744073709551615", "{}", "\\u0000"],
            read: |bytes| {
                let _ = TensorFile::parse(bytes);
            },
        },
        Reader {
            name: "tables",
            corpus: vec![TABLE.clone()],
            words: &["PAR1", "\u{0}\u{0}\u{0}\u{0}", "sha256-seal:", "\u{7f}\u{7f}\u{7f}\u{7f}\u{7f}"],
            read: |bytes| {
                // Only undamaged bytes may reach Polars' decoder.
                if let Ok(file) = TableFile::new(Path::new("hostile.parquet"), bytes.to_vec()) {
                    assert!(bytes == *TABLE);
                    assert_eq!((file.footer().unwrap().rows, file.table(None).unwrap().height()), (3, 3));
                }
            },
        },
    ]
}

const YAML_WORDS: &[&str] = &[
    "&a ",
    "*a",
    "<<: *a",
    "[",
    "]",
    "{",
    "}",
    "- ",
    ": ",
    "\n",
    "!!binary ",
    "1e999",
    "-0",
    "0x",
    "null",
    "~",
    "|\n",
    ">",
    "'",
    "\"",
    "\\x00",
    "---\n",
    "...",
    "? ",
    "# ",
    "=",
    ".",
    "latent",
    "quick:\n",
    "training.epochs",
    "vision",
    "\t",
    "\u{feff}",
    "18446744073709551616",
    "true",
];
const SQL_WORDS: &[&str] = &[
    "select ",
    " from ",
    "runs",
    "metrics",
    " where ",
    "(",
    ")",
    ",",
    "*",
    "null",
    "not ",
    " and ",
    "case ",
    "end",
    " over ()",
    "::",
    "'",
    "\"",
    "--",
    "/*",
    "read_csv('x')",
    "with ",
    "union ",
    "9223372036854775808",
    "-1",
    "0",
    "%",
    "/",
    "interval '1 d'",
    "array",
    "[1]",
    "unnest(",
    "exists (",
    "distinct ",
    "like '%'",
    "~ '('",
    "substr(",
];

/// Checks that a parsed spec has only allowed values, and is the same after writing and reading it again.
fn check_experiment(parsed: Result<Experiment, SpecError>) {
    let Ok(experiment) = parsed else { return };
    let is_allowed = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    assert!(experiment.name.len() <= 64 && experiment.name.chars().all(is_allowed), "{}", experiment.name);
    assert!(experiment.runs().len() <= 10_000);
    assert_eq!(parse(&experiment.to_yaml(), &[]).as_ref(), Ok(&experiment));
}

fn a_tensor_file() -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.safetensors");
    let tensor = |values: &[f32]| {
        candle_core::Tensor::from_slice(values, values.len(), &candle_core::Device::Cpu).unwrap()
    };
    let tensors = HashMap::from([("weight".into(), tensor(&[1.0, 2.0])), ("bias".into(), tensor(&[3.0]))]);
    TensorFile { tensors, note: serde_json::Map::new() }.write(&path).unwrap();
    std::fs::read(path).unwrap()
}

fn a_table() -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.parquet");
    let columns: Vec<_> = Table::Metrics.columns().into_iter().skip(8).collect();
    let text = |name: &str| Column::new(name.into(), ["a", "b", "c"]);
    let table = columns.iter().map(|column| match column.name.as_str() {
        "index" => Column::new("index".into(), [Some(1i64), None, Some(3)]),
        "value" => Column::new("value".into(), [Some(0.5), None, Some(f64::NAN)]),
        name => text(name),
    });
    let table = DataFrame::new(3, table.collect()).unwrap();
    write_table(&path, table, &columns, &Stamp::from([("run".into(), "a".into())])).unwrap();
    std::fs::read(path).unwrap()
}

/// A random input of the corpus with some random changes: to bits, bytes and words, and parts that are removed,
/// repeated or swapped.
fn mutated(reader: &Reader, random: &mut ChaCha8Rng) -> Vec<u8> {
    let pick = |random: &mut ChaCha8Rng| reader.corpus[random.random_range(0..reader.corpus.len())].clone();
    let mut bytes = pick(random);
    for _ in 0..random.random_range(1..6) {
        let at = random.random_range(0..=bytes.len());
        let end = (at + random.random_range(0..40)).min(bytes.len());
        match random.random_range(0..8) {
            0 if at < bytes.len() => bytes[at] ^= 1 << random.random_range(0..8),
            1 if at < bytes.len() => bytes[at] = random.next_u32() as u8,
            2 => drop(bytes.drain(at..end)),
            3 => {
                let part = bytes[at..end].repeat(random.random_range(1..20));
                bytes.splice(at..at, part);
            }
            4 => bytes.truncate(at),
            5 => {
                let other = pick(random);
                let from = random.random_range(0..other.len());
                let to = (from + random.random_range(0..60)).min(other.len());
                bytes.splice(at..end, other[from..to].iter().copied());
            }
            _ => {
                let word = reader.words[random.random_range(0..reader.words.len())];
                bytes.splice(at..end, word.bytes());
            }
        }
    }
    bytes
}

/// Reads one mutation after the other. A mutation that causes a panic is printed, so that it can be added to a test.
fn bombard(reader: &Reader, seed: u64, more: impl Fn(u64) -> bool) -> u64 {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut count = 0;
    while more(count) {
        let bytes = mutated(reader, &mut random);
        if let Err(panic) = std::panic::catch_unwind(|| (reader.read)(&bytes)) {
            eprintln!("{}, mutation {count}: {:?}", reader.name, bytes.escape_ascii().to_string());
            std::panic::resume_unwind(panic);
        }
        count += 1;
    }
    count
}

#[test]
fn mutated_input_is_read_or_refused() {
    for reader in readers() {
        let few = if reader.name == "sql" { 300 } else { 2000 };
        let begin = Instant::now();
        bombard(&reader, 1, |count| count < few);
        println!("{}: {few} in {:.1} s", reader.name, begin.elapsed().as_secs_f64());
    }
}

#[test]
#[ignore = "takes ten minutes a reader"]
fn mutated_input_is_read_or_refused_for_long() {
    let seconds = std::env::var("SOAK_SECONDS").ok().and_then(|text| text.parse().ok()).unwrap_or(600);
    let only = std::env::var("SOAK_READER").ok();
    std::thread::scope(|scope| {
        for reader in
            readers().into_iter().filter(|reader| only.as_ref().is_none_or(|only| only == reader.name))
        {
            scope.spawn(move || {
                let begin = Instant::now();
                let seed = std::time::UNIX_EPOCH.elapsed().unwrap().as_secs();
                let count = bombard(&reader, seed, |_| begin.elapsed() < Duration::from_secs(seconds));
                println!("{}: {count} mutations in {seconds} s, seed {seed}", reader.name);
            });
        }
    });
}
