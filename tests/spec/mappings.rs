//! Mappings of recordings: how their values are read, and which are refused with which message.

use super::ROOT;
use harness_spec::{mapping_schema, read_mapping};
use serde_json::{Value, json};
use std::fs;
use std::path::Path;

/// A valid mapping. Modalities that a test adds start at line 9.
const CSV: &str = "\
name: lab
source: rec
format: csv
sample_rate_hz: 10
max_gap_s: 0.5
streams: {log: {file: '*.csv', time: t}}
modalities:
  setpoint: log.u
";

const PARQUET: &str = "\
name: lab
source: rec
format: parquet
episode: no
order: row
sample_rate_hz: 10
modalities:
  setpoint: u
  x: {from: 'x_?', unit: N}
";

fn read(text: &str) -> Result<Value, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.yaml");
    fs::write(&path, text).unwrap();
    let prefix = format!("{}/", folder.path().display());
    read_mapping(&path).map_err(|error| error.to_string().replace(&prefix, ""))
}

/// The value of `scale` in a mapping that has this text there.
fn scale(text: &str) -> Result<Value, String> {
    read(&format!("{CSV}  x: {{from: log.x, scale: {text}}}\n"))
        .map(|mapping| mapping["modalities"]["x"]["scale"].clone())
}

#[test]
fn numbers_and_words_are_those_of_specs() {
    for (text, value) in [
        ("1e-3", json!(0.001)),
        ("0.5", json!(0.5)),
        (".5", json!(0.5)),
        ("[1, 2e2]", json!([1, 200.0])),
        ("99999999999999999999", json!(1e20)),
    ] {
        assert_eq!(scale(text), Ok(value), "{text}");
    }
    for text in ["1:40", "yes", "true", ".inf", ".nan", "-.inf", "'2'", "[]", "[yes]", "null", ""] {
        let error = scale(text).unwrap_err();
        assert!(
            error.starts_with("m.yaml:9:") && error.contains("'modalities.x.scale': expected a "),
            "{text}: {error}"
        );
    }
    let mapping = read(PARQUET).unwrap();
    assert_eq!(mapping["episode"], "no");
    assert!(mapping["modalities"].as_object().unwrap().keys().eq(["setpoint", "x"]));
}

#[test]
fn a_fault_is_told_with_its_place_and_what_is_allowed() {
    let csv = |rest: &str| format!("{CSV}{rest}\n");
    let line = |old: &str, new: &str| csv("  x: log.x").replace(old, new);
    let cases = [
        (
            String::new(),
            "m.yaml:1:1: the file is empty; `harness import --inspect FILE` writes a first mapping",
        ),
        ("a text".into(), "m.yaml:1:1: expected a section of keys, found the text 'a text'"),
        ("name: [".into(), "m.yaml:1:"),
        (
            line("format: csv", "format: cvs"),
            "m.yaml:3:9: unknown format 'cvs'; did you mean 'csv'? Allowed: lerobot, ",
        ),
        (
            line("format: csv", "format: 1"),
            "m.yaml:3:9: 'format': expected one of lerobot, parquet, csv, hdf5, zarr, ",
        ),
        (
            line("format: csv\n", ""),
            "m.yaml:1:1: missing 'format': one of lerobot, parquet, csv, hdf5, zarr, ",
        ),
        (line("format", "formt"), "m.yaml:3:1: unknown key 'formt'; did you mean 'format'?"),
        (
            line("max_gap_s", "max_gap"),
            "m.yaml:5:1: unknown key 'max_gap'; did you mean 'max_gap_s'? Allowed: name, ",
        ),
        (line("max_gap_s: 0.5\n", ""), "m.yaml:1:1: missing 'max_gap_s'"),
        (
            line("max_gap_s: 0.5", "max_gap_s: .inf"),
            "m.yaml:5:12: 'max_gap_s': expected a finite number above 0 or a text 'unlimited', found inf",
        ),
        (
            line("max_gap_s: 0.5", "max_gap_s: 0"),
            "m.yaml:5:12: 'max_gap_s': expected a finite number above 0",
        ),
        (
            line("max_gap_s: 0.5", "max_gap_s: 1\nmax_episode_s: .inf"),
            "m.yaml:6:16: 'max_episode_s': expected a finite ",
        ),
        (
            line("max_gap_s: 0.5", "max_gap_s: 1\nalign: lst"),
            "m.yaml:6:8: unknown align 'lst' in 'align'; did you mean 'last'?",
        ),
        (
            line("sample_rate_hz: 10", "sample_rate_hz: 0"),
            "m.yaml:4:17: 'sample_rate_hz': expected a finite number of at ",
        ),
        (
            line("name: lab", "name: empty"),
            "m.yaml:1:7: 'name': 'empty' can't name an imported dataset; use 1 to 64 ",
        ),
        (line("name: lab", "name: ../x"), "m.yaml:1:7: 'name': '../x' can't name an imported dataset"),
        (
            line("source: rec", "source: 2024"),
            "m.yaml:2:9: 'source': expected a text, found 2024; put a text that looks ",
        ),
        (csv("name: other\n"), "m.yaml:9:1: "),
        (
            line("file: '*.csv', time: t", "fiel: a"),
            "m.yaml:6:17: unknown key 'fiel' in 'streams.log'; did you mean 'file'?",
        ),
        (
            line("time: t", "time: t, rate_hz: 5"),
            "m.yaml:6:50: 'streams.log.rate_hz': the stream has times; remove ",
        ),
        (line("time: t", "time_unit: m"), "m.yaml:6:43: unknown time_unit 'm' in 'streams.log.time_unit'"),
        (
            line("{log:", "{Log:"),
            "m.yaml:6:11: 'Log' in 'streams' can't be a name; use 1 to 64 lower-case letters",
        ),
        (
            line("streams: {log: {file: '*.csv', time: t}}", "streams: 3"),
            "m.yaml:6:10: 'streams': expected a section",
        ),
        (csv(""), "m.yaml:8:3: 'modalities': there is nothing to learn from the setpoint alone"),
        (line("  setpoint: log.u", "  y: log.y"), "m.yaml:8:3: missing 'modalities.setpoint'"),
        (
            line("setpoint: log.u", "setpoint:"),
            "m.yaml:8:11: 'modalities.setpoint': expected a text or a list of at ",
        ),
        (
            line("setpoint: log.u", "setpoint: {from: log.u, shift: 2}"),
            "m.yaml:8:34: 'modalities.setpoint.shift': expected ",
        ),
        (
            csv("  x: {from: log.x, shift: 1}"),
            "m.yaml:9:20: unknown key 'shift' in 'modalities.x'. Allowed: from, label",
        ),
        (csv("  X: log.x"), "m.yaml:9:3: 'X' in 'modalities' can't be a name"),
        (
            csv("  x: 3"),
            "m.yaml:9:6: 'modalities.x': expected a text or a list of at least one item, each a text or a ",
        ),
        (csv("  x: {scale: 2}"), "m.yaml:9:6: missing 'modalities.x.from'"),
        (csv("  x: {form: log.x}"), "m.yaml:9:7: unknown key 'form' in 'modalities.x'; did you mean 'from'?"),
        (csv("  x: {from: [log.x, 3]}"), "m.yaml:9:21: 'modalities.x.from': expected a text, found 3"),
        (
            csv("  pad: {from: log.x, size: [0, 4]}"),
            "m.yaml:9:29: 'modalities.pad.size': expected an integer of at least 1",
        ),
        (
            csv("  pad: {from: log.x, size: [4]}"),
            "m.yaml:9:28: 'modalities.pad.size': expected a list of 2 items",
        ),
        (
            csv("  factors: log.x"),
            "m.yaml:9:12: 'modalities.factors': this name means something else in the tables",
        ),
        (
            csv("  frame_difference: log.x"),
            "m.yaml:9:21: 'modalities.frame_difference': this name means something",
        ),
        (csv("  arm: {from: log.x, unit: V}"), "m.yaml:9:28: 'modalities.arm.unit': is that of the finger's"),
        (
            csv("  arm: {from: log.x, size: [8, 8]}"),
            "m.yaml:9:28: 'modalities.arm.size': the finger has a vector of this",
        ),
        (
            csv("  vision: {from: log.x, scale: 2}"),
            "m.yaml:9:32: 'modalities.vision.scale': only a vector has this key",
        ),
        (
            csv(r#"  x: {from: log.x, unit: "m\n"}"#),
            "m.yaml:9:26: 'modalities.x.unit': a unit has no line breaks",
        ),
        (csv("  vision: [log.x, log.y]"), "m.yaml:9:11: 'modalities.vision': an image is from one column"),
        (
            csv("  wrist: {from: log.x, size: [8, 8]}\n  wrist_difference: log.y"),
            "m.yaml:9:10: 'modalities.wrist': the change of this image is called 'wrist_difference', and another modality",
        ),
        (
            csv("  vision: log.x\n  frame: {from: log.y, size: [8, 8]}"),
            "m.yaml:9:11: 'modalities.vision': the change of this image is called 'frame_difference', and so is that of",
        ),
        (
            csv(&format!("  {}: {{from: log.x, size: [8, 8]}}", "w".repeat(60))),
            &format!(
                "m.yaml:9:65: 'modalities.{}': the change of this image is called '{0}_difference', and this is longer",
                "w".repeat(60)
            ),
        ),
        (PARQUET.replace("order: row\n", ""), "m.yaml:1:1: missing 'order'"),
        (
            line("format: csv", "format: hdf5\nepisodes: 'd_*'\nepisode_ends: ends")
                .replace("file: '*.csv'", "data: log"),
            "m.yaml:5:15: 'episode_ends': 'episodes' divides the recording into episodes already; remove one of them",
        ),
        (line("format: csv", "format: zarr"), "m.yaml:6:17: unknown key 'file' in 'streams.log'"),
        (
            csv("  x: {from: log.x, crop: [0, 0, 8, 8]}"),
            "m.yaml:9:26: 'modalities.x.crop': only an image, which has a size, has this key",
        ),
        (
            csv("  x: {from: log.x, angle: deg, quaternion: xyzw}"),
            "m.yaml:9:44: 'modalities.x.quaternion': a modality is an angle or a quaternion",
        ),
        (
            csv("  x: {from: log.x, categories: [a]}"),
            "m.yaml:9:32: 'modalities.x.categories': expected a list of at least 2 items",
        ),
        (
            csv("  x: {from: log.x, categories: [a, a]}"),
            "m.yaml:9:36: \"a\" is in 'modalities.x.categories' twice",
        ),
        (
            csv("  x: {from: log.x, categories: [a, b], unit: N}"),
            "m.yaml:9:46: 'modalities.x.unit': categories have no such key; remove it",
        ),
        (
            csv("  y: log.y\n  x: {from: log.x, label: object}"),
            "m.yaml:10:13: 'modalities.x.from': categories are from columns or from a label; remove one of them",
        ),
        (
            csv("  y: log.y\n  arm: {label: object}"),
            "m.yaml:10:16: 'modalities.arm.label': the finger has values of this name; give categories another name",
        ),
        (
            csv("  x: {label: object}"),
            "m.yaml:8:3: 'modalities': there is nothing to learn from labels alone; name what was sensed",
        ),
        (line("time: t", "time: [t]"), "m.yaml:6:38: 'streams.log.time': expected a list of 2 items"),
        (line("time: t", "time: t, header: no"), "m.yaml:6:49: 'streams.log.header': expected "),
    ];
    for (text, message) in cases {
        let error = read(&text).expect_err(&text);
        assert!(error.starts_with(message), "{text}\nexpected {message}\nfound    {error}");
    }
}

#[test]
fn a_parquet_file_has_rows_that_are_samples_or_streams_with_keys_for_cleaning() {
    assert!(read(PARQUET).is_ok());
    assert_eq!(read(&format!("{CSV}  x: log.x\n  y: {{label: object, categories: [1, b]}}\n")).err(), None);
    let keys =
        "time: [t, ns], missing: skip, missing_values: [NA, null, '-', -9999], header: none, offset_s: delay";
    let text = format!("{CSV}  x: {{from: log.x, angle: deg}}\n").replace("time: t", keys);
    let text = text.replace("format: csv", "format: parquet\nsteps_back: split\nfrom_s: start\nto_s: 9.5");
    assert_eq!(read(&text).err(), None);
}

#[test]
fn the_mappings_of_the_documentation_are_valid() {
    let mut count = 0;
    for page in fs::read_dir(Path::new(ROOT).join("docs")).unwrap() {
        let text = fs::read_to_string(page.unwrap().path()).unwrap_or_default();
        for block in text.split("```yaml\n").skip(1).map(|rest| rest.split("```").next().unwrap()) {
            if block.contains("\nmodalities:") && block.contains("\nformat:") {
                assert_eq!(read(block).err(), None, "{block}");
                count += 1;
            }
        }
    }
    assert_eq!(count, 4);
}

/// `check` overlooks a reference to nowhere, and every other format's key would then be refused.
#[test]
fn every_reference_in_the_schema_leads_to_a_definition_and_every_definition_is_used() {
    let schema = mapping_schema();
    let text = schema.to_string();
    let used: Vec<&str> =
        text.split("\"#/$defs/").skip(1).map(|rest| rest.split('"').next().unwrap()).collect();
    let defined: Vec<&String> = schema["$defs"].as_object().unwrap().keys().collect();
    assert!(used.iter().all(|name| defined.iter().any(|own| own == name)), "{used:?}");
    assert!(defined.iter().all(|own| used.contains(&own.as_str())), "{defined:?}");
}
