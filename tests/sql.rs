//! SQL queries are answered as the standard says, or refused with a message that says what to write instead.

use crate::common::{finish, harness, published_only, succeed};
use harness::catalog::{query, query_recorded, save};
use harness::registry::{Recorded, Registry};
use harness::sql::{Condition, implies};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;

/// Most of the published results.
static RESULTS: LazyLock<PathBuf> = LazyLock::new(|| published_only(&EXPERIMENTS, "sql"));

/// The published experiments that the queries are about.
const EXPERIMENTS: [&str; 6] =
    ["choose_recommended", "intervals", "missing", "recommended", "reproduction", "which_sense"];

/// An entry of tests/sql/corpus.sql.
struct Entry {
    about: String,
    /// A part of the message with which the query is refused, or `None` if it is answered.
    message: Option<String>,
    sql: String,
}

fn corpus() -> Vec<Entry> {
    let text = include_str!("sql/corpus.sql");
    let mut entries: Vec<Entry> = Vec::new();
    for line in text.lines() {
        let begun = line.strip_prefix("-- agree: ").map(|about| (about, None)).or_else(|| {
            let (about, message) = line.strip_prefix("-- refuse: ")?.split_once(" | ").expect("a message");
            Some((about, Some(message.to_owned())))
        });
        match (begun, entries.last_mut()) {
            (Some((about, message)), _) => {
                entries.push(Entry { about: about.to_owned(), message, sql: String::new() });
            }
            (None, Some(entry)) => entry.sql.extend([line, "\n"]),
            // Comments at the beginning of the file.
            (None, None) => {}
        }
    }
    entries
}

/// These results, whose records are read once.
static PUBLISHED: LazyLock<(Registry, Vec<Recorded>)> = LazyLock::new(|| {
    let registry = Registry::new(&*RESULTS);
    let runs = registry.recorded();
    (registry, runs)
});

fn answer(sql: &str) -> Result<polars::prelude::DataFrame, String> {
    let (registry, runs) = &*PUBLISHED;
    query_recorded(registry, runs, sql).map_err(|error| error.to_string())
}

#[test]
fn every_query_of_the_corpus_agrees_with_duckdb() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let (mut queries, mut refused) = (Vec::new(), Vec::new());
    for (number, entry) in corpus().into_iter().filter(|entry| entry.message.is_none()).enumerate() {
        let mut found = match answer(&entry.sql) {
            Ok(found) => found,
            Err(message) => {
                refused.push(format!("{}: {message}", entry.about));
                continue;
            }
        };
        let name = format!("{number}.parquet");
        save(&mut found, &path(&name)).unwrap();
        queries.push(serde_json::json!({"about": entry.about, "sql": entry.sql, "answer": name}));
    }
    assert!(refused.is_empty(), "{}", refused.join("\n"));
    assert!(queries.len() >= 520, "{}", queries.len());
    save(&mut answer("select * from runs").unwrap(), &path("runs.parquet")).unwrap();
    std::fs::write(path("queries.json"), serde_json::to_vec(&queries).unwrap()).unwrap();

    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let script = root.join("tests/python/compare_sql.py");
    let output =
        Command::new(root.join(".venv/bin/python")).arg(script).arg(&*RESULTS).arg(folder.path()).output();
    let output = output.expect("the virtual environment of the tests is there: `make test` sets it up");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let differences: Vec<serde_json::Value> = serde_json::from_slice(&output.stdout).unwrap();
    assert!(differences.is_empty(), "{}", serde_json::to_string_pretty(&differences).unwrap());
}

#[test]
fn every_other_query_is_refused_with_what_to_write_instead() {
    let mut wrong = Vec::new();
    for Entry { about, message, sql } in corpus() {
        let Some(expected) = message else { continue };
        match answer(&sql) {
            Ok(found) => wrong.push(format!("{about}: answered\n{found}")),
            Err(message) if !message.contains(&expected) || message.lines().count() != 1 => {
                wrong.push(format!("{about}: {message}"));
            }
            Err(_) => {}
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn every_function_is_in_the_corpus() {
    let message = answer("select nothing_like_it(1)").unwrap_err();
    let (_, names) = message.split_once("there are ").unwrap();
    let asked: String =
        corpus().into_iter().filter(|entry| entry.message.is_none()).map(|entry| entry.sql).collect();
    for name in names.split(", ") {
        assert!(asked.contains(&format!("{name}(")), "{name} is not compared with DuckDB's");
    }
    assert!(names.split(", ").count() > 50);
    let page = include_str!("../docs/tables.md");
    for name in names.split(", ") {
        assert!(page.contains(&format!("`{name}`")), "docs/tables.md lacks {name}");
    }
}

#[test]
fn columns_without_a_name_have_the_name_of_what_they_are() {
    let names = |sql: &str| -> Vec<String> {
        answer(sql).unwrap().get_column_names().into_iter().map(|name| name.to_string()).collect()
    };
    assert_eq!(
        names("select metric, avg( value ), max(value), count(*), avg(value) from metrics group by metric"),
        ["metric", "avg(value)", "max(value)", "count(*)", "avg(value)_1"]
    );
    assert_eq!(
        names("select a.run, b.run, a.run as run_1, b.latent+1 from runs a join runs b on a.run = b.run"),
        ["run", "run_2", "run_1", "b.latent + 1"]
    );
}

#[test]
fn tables_and_their_columns_can_be_listed() {
    for sql in ["show tables", "SHOW TABLES;"] {
        let printed = succeed(&RESULTS, &["query", sql]);
        for table in harness::schema::Table::ALL {
            assert!(printed.contains(table.name()) && printed.contains(table.meaning()), "{printed}");
        }
    }
    for sql in ["describe metrics", "DESC metrics;", "show columns from metrics"] {
        let printed = succeed(&RESULTS, &["query", sql]);
        for column in harness::schema::Table::Metrics.columns() {
            assert!(printed.contains(&column.name) && printed.contains(&*column.unit), "{sql}: {printed}");
        }
        assert!(printed.contains("integer") && printed.contains("null if it is not defined"), "{printed}");
    }
    let refused = finish(&mut harness(&RESULTS, &["query", "describe metric"]));
    assert_eq!(refused.code, 2);
    assert!(
        refused.stderr.contains("there is no table 'metric'; did you mean 'metrics'?"),
        "{}",
        refused.stderr
    );
    let plan = answer("explain select run from runs where latent = 4").unwrap();
    assert_eq!(plan.get_column_names(), ["plan"]);
}

#[test]
fn a_text_without_quotes_is_named_with_them() {
    for sql in ["select run from runs where status = done", "select run from runs where status in (done)"] {
        let message = answer(sql).unwrap_err();
        assert!(message.contains("there is no column 'done'; there are "), "{message}");
        assert!(message.ends_with(". Write text in single quotes: 'done'"), "{message}");
    }
    let message = answer("select done from runs").unwrap_err();
    assert!(!message.contains("single quotes"), "{message}");
}

#[test]
fn an_answer_is_written_to_a_folder_that_is_not_there_yet() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a/b/answer.csv");
    succeed(&RESULTS, &["query", "select run from runs limit 2", "-o", path.to_str().unwrap()]);
    assert_eq!(std::fs::read_to_string(path).unwrap().lines().count(), 3);
}

#[test]
fn an_outer_join_has_the_same_rows_each_time() {
    // The order of distinct rows differs between evaluations. Each has to be in the answer, with a partner or without.
    let sql = "select s.scenario, l.latent, count(r.run) as n
               from (select distinct scenario from runs) s cross join (select distinct latent from runs) l
               left join runs r on r.scenario = s.scenario and r.latent = l.latent group by all order by all";
    let first = answer(sql).unwrap();
    let distinct = |column| answer(&format!("select distinct {column} from runs")).unwrap().height();
    assert_eq!(first.height(), distinct("scenario") * distinct("latent"));
    for _ in 0..30 {
        assert!(answer(sql).unwrap().equals_missing(&first));
    }
}

#[test]
fn rows_come_in_the_same_order_each_time() {
    for sql in [
        "select metric, modality, index, count(*) from metrics group by metric, modality, index",
        "select distinct run, metric from metrics",
        "select a.run, b.epoch from runs a join epochs b on a.run = b.run where b.term = 'total'",
        "select run from runs union select dataset from runs",
        "select run, rank() over (partition by scenario order by latent) from runs",
    ] {
        let first = answer(sql).unwrap();
        for _ in 0..3 {
            assert!(answer(sql).unwrap().equals_missing(&first), "{sql}");
        }
    }
}

#[test]
fn a_query_takes_no_more_memory_than_its_joins_may_have() {
    // 10,000 x 10,000 rows took 1.8 GB.
    let wide = "with a as (select value from metrics limit 10000) select count(*) from a x cross join a y";
    assert!(answer(wide).unwrap_err().contains("a join in it has 100000000 rows, but at most 1000000 are"));
    // A subquery is repeatedly joined with itself, or repeatedly combined with itself.
    let doubled = |body: &str| {
        let first = "with t0 as (select latent, seed from runs)".to_owned();
        let with = (0..20).fold(first, |with, n| {
            format!("{with}, t{} as ({})", n + 1, body.replace('T', &format!("t{n}")))
        });
        answer(&format!("{with} select count(*) from t20")).unwrap_err()
    };
    assert!(
        doubled("select a.latent, a.seed from T a join T b on a.seed = b.seed")
            .contains("rows, but at most 1000000 are")
    );
    assert!(
        doubled("select * from T union all select * from T")
            .contains("reads tables 256 times, but at most 200 are")
    );
    // Rows that a condition excludes are not joined.
    for few in [
        "select count(*) as n from metrics a join metrics b on a.scenario = b.scenario where a.value > 1e300",
        "select count(*) as n from metrics a join metrics b on a.scenario = b.scenario and b.value > 1e300",
        "select count(*) as n from (select * from metrics where value > 1e300) a cross join metrics b",
    ] {
        assert_eq!(answer(few).unwrap().column("n").unwrap().i64().unwrap().get(0), Some(0));
    }
}

#[test]
fn bytes_are_shown_as_their_number_and_saved_only_as_parquet() {
    let shown = succeed(&RESULTS, &["query", "select reference from frames limit 1"]);
    assert!(shown.contains(" bytes"), "{shown}");
    let mut answer = query(&Registry::new(&*RESULTS), "select run, reference from frames limit 2").unwrap();
    let folder = tempfile::tempdir().unwrap();
    save(&mut answer, &folder.path().join("answer.parquet")).unwrap();
    for name in ["answer.csv", "answer.json"] {
        let path = folder.path().join(name);
        let expected = format!(
            "can't write to '{}': the column 'reference' holds bytes; choose a name that ends in .parquet, or leave \
             the column out",
            path.display()
        );
        assert_eq!(save(&mut answer, &path).unwrap_err().to_string(), expected);
        assert!(!path.exists());
    }
}

fn condition(terms: &[(&str, &[&str])]) -> Condition {
    let set = |texts: &[&str]| texts.iter().map(|text| (*text).to_owned()).collect();
    terms.iter().map(|(column, texts)| ((*column).to_owned(), set(texts))).collect()
}

#[test]
fn a_condition_implies_those_that_ask_for_less() {
    let narrow = condition(&[("metric", &["r2"]), ("model", &["network"]), ("index", &[])]);
    for wide in [
        condition(&[]),
        condition(&[("metric", &["r2", "nmse"])]),
        condition(&[("model", &["network"]), ("index", &[])]),
    ] {
        assert!(implies(&narrow, &wide), "{wide:?}");
    }
    for other in [
        condition(&[("metric", &["nmse"])]),
        condition(&[("metric", &[])]),
        condition(&[("index", &["1"])]),
        condition(&[("task", &["prediction"])]),
    ] {
        assert!(!implies(&narrow, &other), "{other:?}");
    }
}
