//! The value of a sense: in a world with a known answer, the commands of docs/value-of-a-sense.md find it.

use crate::common::{ask, fresh, succeed};
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

const PAGE: &str = include_str!("../docs/value-of-a-sense.md");

/// The file that the page says to save under this name.
fn file(name: &str) -> &'static str {
    let (_, block) = PAGE.split_once(&format!("<!-- file: {name} -->\n```")).unwrap();
    let (_language, text) = block.split_once('\n').unwrap();
    text.split_once("```").unwrap().0
}

/// The values of a query's only number, by its only text.
fn numbers(results: &Path, sql: &str) -> BTreeMap<String, f64> {
    let number =
        |row: &serde_json::Value| (row["key"].as_str().unwrap().to_owned(), row["value"].as_f64().unwrap());
    ask(results, sql).iter().map(number).collect()
}

#[test]
fn an_oracle_and_a_camera_tell_a_force_of_an_unseen_height() {
    let results = fresh("value");
    for name in ["dome/dome.xml", "dome/dome.yaml", "dome/value.yaml"] {
        fs::create_dir_all(results.join("dome")).unwrap();
        fs::write(results.join(name), file(name)).unwrap();
    }
    let spec = results.join("dome/value.yaml").display().to_string();
    succeed(&results, &["run", &spec]);
    let of_force = "modality = 'contact_force' and metric = 'r2' and model = 'network' and index is null and direction \
                    is null";
    let r2 = numbers(
        &results,
        &format!("select variant as key, avg(value) as value from metrics where {of_force} group by variant"),
    );
    let [without, oracle, camera] =
        ["without_sight", "oracle", "camera"].map(|label| r2[&format!("sight={label}")]);
    assert!(oracle > 0.99 && camera > 0.9, "{r2:?}");
    // Zero is within the interval of the same network without sight.
    let each = numbers(
        &results,
        &format!(
            "select run as key, value from metrics where {of_force} and variant = 'sight=without_sight'"
        ),
    );
    let squares: f64 = each.values().map(|value| (value - without).powi(2)).sum();
    // Student's t for two degrees of freedom, times the standard error.
    let half = 4.302_652_73 * (squares / 2.0 / 3.0).sqrt();
    assert!(each.len() == 3 && without.abs() < half, "{each:?}");
}
