//! `query`, `ls`, `compare` and `claims` print their tables for people and for programs, by the same option.

use crate::common::{finish, harness, succeed};
use polars::prelude::{AnyValue, DataFrame, ParquetReader, SerReader};
use std::fs::File;
use std::path::{Path, PathBuf};

/// A query whose answer has nulls, integers, texts with commas and quotes, and real numbers of 17 digits.
const SQL: &str = "select experiment, run, 'a, \"b\" | c' as text, latent, prediction_seconds / 3 as third, reason \
                   from runs join (select experiment, run from epochs where term = 'total' and split = 'train') \
                   using (experiment, run) order by experiment, run limit 300";

/// The commands, and the noun for their rows.
const COMMANDS: [(&[&str], &str); 4] = [
    (&["query", SQL], "row"),
    (&["ls", "which_sense"], "run"),
    (&["compare", "recommended"], "mean"),
    (&["claims", "forces_are_distal", "force_errors_stay_high"], "verdict"),
];

fn reference() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("results/reference")
}

fn printed(command: &[&str], format: &str) -> String {
    succeed(&reference(), &[command, &["--format", format]].concat())
}

/// The table that a command writes as Parquet, which has all digits.
fn written(command: &[&str], noun: &str) -> DataFrame {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("table.parquet");
    let said = succeed(&reference(), &[command, &["--output", path.to_str().unwrap()]].concat());
    let table = ParquetReader::new(File::open(&path).unwrap()).finish().unwrap();
    assert_eq!(said, format!("{} {noun}s in {}\n", table.height(), path.display()));
    table
}

/// The fields of a line of CSV.
fn fields(line: &str) -> Vec<String> {
    let (mut fields, mut is_quoted) = (vec![String::new()], false);
    let mut letters = line.chars().peekable();
    while let Some(letter) = letters.next() {
        match letter {
            '"' if is_quoted && letters.peek() == Some(&'"') => {
                fields.last_mut().unwrap().extend(letters.next())
            }
            '"' => is_quoted = !is_quoted,
            ',' if !is_quoted => fields.push(String::new()),
            other => fields.last_mut().unwrap().push(other),
        }
    }
    fields
}

#[test]
fn csv_has_all_rows_and_all_digits() {
    for (command, noun) in COMMANDS {
        let table = written(command, noun);
        let csv = printed(command, "csv");
        let mut lines = csv.lines().map(fields);
        let names: Vec<String> = table.get_column_names().into_iter().map(|name| name.to_string()).collect();
        assert_eq!(lines.next().unwrap(), names, "{command:?}");
        let rows: Vec<Vec<String>> = lines.collect();
        assert_eq!(rows.len(), table.height(), "{command:?}");
        for (place, row) in rows.iter().enumerate() {
            for (cell, column) in row.iter().zip(table.columns()) {
                match column.get(place).unwrap() {
                    AnyValue::Null => assert_eq!(cell, ""),
                    AnyValue::Float64(value) => assert_eq!(cell.parse::<f64>().unwrap(), value),
                    AnyValue::Int64(value) => assert_eq!(cell.parse::<i64>().unwrap(), value),
                    other => assert_eq!(*cell, other.str_value()),
                }
            }
        }
    }
}

#[test]
fn json_has_all_rows_and_all_digits() {
    for (command, noun) in COMMANDS {
        let table = written(command, noun);
        let rows: Vec<serde_json::Value> = serde_json::from_str(&printed(command, "json")).unwrap();
        assert_eq!(rows.len(), table.height(), "{command:?}");
        for (place, row) in rows.iter().enumerate() {
            assert_eq!(row.as_object().unwrap().len(), table.width());
            for column in table.columns() {
                let cell = &row[column.name().as_str()];
                match column.get(place).unwrap() {
                    AnyValue::Null => assert!(cell.is_null()),
                    AnyValue::Float64(value) => assert_eq!(cell.as_f64(), Some(value)),
                    AnyValue::Int64(value) => assert_eq!(cell.as_i64(), Some(value)),
                    other => assert_eq!(cell.as_str().unwrap(), other.str_value()),
                }
            }
        }
    }
}

#[test]
fn markdown_and_latex_have_all_rows() {
    for (command, noun) in COMMANDS {
        let markdown = printed(command, "markdown");
        let lines: Vec<&str> = markdown.lines().take_while(|line| line.starts_with('|')).collect();
        let bars = |line: &str| line.replace("\\|", "").matches('|').count();
        assert!(lines.iter().all(|line| bars(line) == bars(lines[0]) && line.ends_with('|')), "{markdown}");
        assert!(lines[1].chars().all(|sign| "|-: ".contains(sign)), "{markdown}");
        let latex = printed(command, "latex");
        let ends = latex.matches(r" \\").count();
        assert!(latex.contains("\\begin{tabular}{") && latex.ends_with("\\end{tabular}\n"), "{latex}");
        // A header and, in Markdown, the line below it.
        assert_eq!((lines.len() - 2, ends - 1), (lines.len() - 2, lines.len() - 2), "{command:?}");
        if command[0] != "compare" {
            assert_eq!(lines.len() - 2, written(command, noun).height(), "{command:?}");
        }
    }
    assert!(printed(COMMANDS[0].0, "markdown").contains(r#"a, "b" \| c"#));
    assert!(
        printed(&["query", "select 'a_b' as \"50 %\""], "latex")
            .contains("50 \\% \\\\\n\\midrule\na\\_b \\\\")
    );
}

#[test]
fn text_is_what_commands_print_without_a_format() {
    for (command, _) in COMMANDS {
        assert_eq!(printed(command, "text"), succeed(&reference(), command));
    }
    let text = printed(COMMANDS[0].0, "text");
    assert!(
        text.ends_with(
            "100 more rows; print all with `--format csv`, or write them with `--output FILE.csv`\n"
        )
    );
}

#[test]
fn a_format_and_a_file_are_refused_together() {
    for (command, _) in COMMANDS {
        for format in ["latex", "csv"] {
            let arguments = [command, &["--format", format, "--output", "x.csv"]].concat();
            let answer = finish(&mut harness(&reference(), &arguments));
            assert_eq!(answer.code, 2);
            let expected = "--format is the format of the standard output, and the ending of 'x.csv' that of the file; \
                            leave out --format or --output";
            assert!(answer.stderr.contains(expected), "{}", answer.stderr);
        }
    }
    let answer = finish(&mut harness(&reference(), &["ls", "--format", "xml"]));
    assert_eq!(answer.code, 2);
    assert!(
        answer.stderr.contains("[possible values: text, markdown, latex, csv, json]"),
        "{}",
        answer.stderr
    );
}

#[test]
fn json_says_which_numbers_it_can_not_hold() {
    let folder = tempfile::tempdir().unwrap();
    let sql =
        "select 0 / 0 as x, 1 as y, 1.5 as z union all select 1 / 0, 2, null union all select 2.5, 3, -1 / 0";
    let said =
        "NaN and infinity are null in JSON: 2 values of 'x', 1 value of 'z'; CSV and Parquet keep them\n";
    for to in [["--format", "json"], ["--output", folder.path().join("x.json").to_str().unwrap()]] {
        let answer = finish(&mut harness(&reference(), &[&["query", sql], &to[..]].concat()));
        assert_eq!((answer.code, &*answer.stderr), (0, said));
    }
    let rows = printed(&["query", sql], "json");
    assert_eq!(
        rows,
        "[{\"x\":null,\"y\":1,\"z\":1.5},{\"x\":null,\"y\":2,\"z\":null},{\"x\":2.5,\"y\":3,\"z\":null}]\n"
    );
    let csv = finish(&mut harness(&reference(), &["query", sql, "--format", "csv"]));
    assert_eq!((&*csv.stdout, &*csv.stderr), ("x,y,z\nNaN,1,1.5\ninf,2,\n2.5,3,-inf\n", ""));
}

#[test]
fn bytes_are_refused_in_formats_that_can_not_hold_them() {
    for format in ["csv", "json"] {
        let arguments = ["query", "select run, reference from frames limit 1", "--format", format];
        let answer = finish(&mut harness(&reference(), &arguments));
        assert_eq!((answer.code, &*answer.stdout), (2, ""));
        let expected = "the column 'reference' holds bytes, which CSV and JSON can't hold; leave it out, or write \
                        Parquet with --output FILE.parquet";
        assert!(answer.stderr.contains(expected), "{}", answer.stderr);
    }
}

#[test]
fn the_columns_of_episodes_are_those_of_a_world() {
    let without = succeed(&reference(), &["schema", "--tables"]);
    let command = format!("harness --results {} schema --tables --world FILE", reference().display());
    assert!(
        without.contains("The columns after time follow the world: these are those of the built-in worlds"),
        "{without}"
    );
    assert!(without.contains(&command) && without.contains("contact_force_19"), "{without}");
    let of_world = succeed(&reference(), &["schema", "--tables", "--world", "empty"]);
    assert!(
        of_world.contains("these are those of empty\n") && of_world.contains("contact_force_19"),
        "{of_world}"
    );
    let refused = finish(&mut harness(&reference(), &["schema", "--tables", "--world", "nowhere.yaml"]));
    assert_eq!(refused.code, 2, "{}", refused.stderr);
}
