//! The benchmarks: all contenders do the same work, and the table has the measured numbers.

use std::path::{Path, PathBuf};
use std::process::Command;

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

/// The output of a command, which must succeed.
#[track_caller]
fn said(command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{command:?}:\n{out}{err}");
    out.into_owned()
}

fn python(script: &str) -> Command {
    let mut command = Command::new(Path::new(ROOT).join(".venv/bin/python"));
    command.arg(Path::new(ROOT).join(script));
    command
}

/// The program of an example. `cargo test` builds the examples, `cargo test --test all` does not.
fn example(name: &str) -> Command {
    let program = Path::new(env!("CARGO_BIN_EXE_harness")).with_file_name("examples").join(name);
    assert!(program.exists(), "{} is not there: `cargo build --examples`", program.display());
    Command::new(program)
}

/// The last line of an output, as JSON.
fn last_json(printed: &str) -> serde_json::Value {
    serde_json::from_str(printed.lines().last().unwrap()).unwrap()
}

/// Compiles raw_limit.c as compare.py does.
fn raw_limit(folder: &Path) -> PathBuf {
    let library = Path::new(ROOT).join(".venv/mujoco");
    let include = library.join("libmujoco.so").canonicalize().unwrap().with_file_name("include");
    let program = folder.join("raw_limit");
    let mut compiler = Command::new("cc");
    compiler.args(["-Wall", "-Wextra", "-Werror", "-O2", "-I"]).arg(include);
    compiler.arg(Path::new(ROOT).join("harness/benches/raw_limit.c")).arg("-o").arg(&program);
    compiler.arg("-L").arg(&library).args(["-lmujoco", "-ldl", "-lpthread"]);
    said(compiler.arg(format!("-Wl,-rpath,{}", library.display())));
    program
}

#[test]
fn collectors_in_python_and_c_arrive_where_the_harness_does() {
    let folder = tempfile::tempdir().unwrap();
    let raw_limit = raw_limit(folder.path());
    for scenario in ["empty", "cluttered"] {
        let courses = folder.path().join(scenario);
        let mut export = example("courses");
        export.args(["--scenario", scenario, "--episodes", "2", "--actuations", "2", "--output"]);
        said(export.arg(&courses));
        // Both programs end with an error unless the last positions are those of the file, bit by bit.
        let model = Path::new(ROOT).join(format!("models/{scenario}.xml"));
        let report = last_json(&said(Command::new(&raw_limit).arg(&model).arg(&courses).arg("2")));
        assert_eq!((&report["samples"], &report["steps"]), (&40.into(), &(2 * 1901).into()));
        let mut collect = python("harness/benches/collect.py");
        collect.args(["--scenario", scenario, "--processes", "1", "--courses"]).arg(&courses);
        assert_eq!(last_json(&said(&mut collect))["samples"], 40);

        // The last 8 bytes before the controls of an episode are its last position.
        let mut bytes = std::fs::read(&courses).unwrap();
        let end = bytes.len() - 1901 * 3 * 8;
        bytes[end - 8] ^= 1;
        std::fs::write(&courses, bytes).unwrap();
        let output = Command::new(&raw_limit).arg(&model).arg(&courses).arg("1").output().unwrap();
        assert!(!output.status.success());
        assert!(String::from_utf8_lossy(&output.stderr).contains("the last positions are not those"));
        let output = collect.output().unwrap();
        assert!(String::from_utf8_lossy(&output.stderr).contains("did not end where its course says"));
        assert!(!output.status.success());
    }
}

#[test]
fn products_are_those_of_the_layers() {
    let products = |options: &[&str]| {
        let mut products = example("products");
        products.args(["--latent", "4", "--batch", "10", "--hidden", "8", "--steps", "1"]).args(options);
        products
    };
    let operations =
        |options: &[&str]| last_json(&said(&mut products(options)))["gigaflop"].as_f64().unwrap();
    // Multiplications a sample: 20 to 8 on data (forward, weights); 8 to 2 x 4, 4 + 3 to 8 and 8 to 40 (and inputs).
    let multiplications = 2 * 20 * 8 + 3 * (8 * 8 + 7 * 8 + 8 * 40);
    assert_eq!(operations(&[]), f64::from(2 * 10 * multiplications) / 1e9);
    // With frames, 5 channels of 32 x 32 places, each from 3 x 4 x 4 values (two products in the encoder, three in the
    // decoder), to 8 and back (and inputs).
    let with_frames = multiplications + 5 * (5 * 32 * 32 * 48) + 2 * 3 * (8 * 5 * 32 * 32);
    assert_eq!(operations(&["--channels", "5"]), f64::from(2 * 10 * with_frames) / 1e9);

    let deeper = products(&["--channels", "5", "6"]).output().unwrap();
    assert!(!deeper.status.success());
    let message = String::from_utf8(deeper.stderr).unwrap();
    assert_eq!(message, "products: --channels takes one number or none: deeper networks are not supported\n");
}

#[test]
fn the_table_says_how_many_times_as_fast_the_harness_is() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("benchmarks.parquet");
    let printed = said(python("tests/python/benchmark_table.py").arg(&file));
    // 0.2 s is 2.5 times as fast as 0.5 s, and 500 per second as 200 per second. The numbers are medians of three
    // rounds.
    assert!(printed.contains("| a step |"), "{printed}");
    let rows: Vec<Vec<&str>> = printed
        .lines()
        .filter(|line| line.starts_with('|'))
        .map(|line| line.trim_matches('|').split('|').map(str::trim).collect())
        .collect();
    assert_eq!(rows[2], ["a step", "200 ms", "peer", "500 ms", "2.50", "2.0"]);
    assert_eq!(rows[3], ["a rate", "500 samples/s", "peer", "200 samples/s", "2.50", ""]);
    let read = last_json(&printed);
    assert_eq!(read["ratio"], serde_json::json!([1.0, 2.5, 1.0, 2.5]));
    assert_eq!(read["units"]["memory_bytes"], "B");
    assert_eq!(read["columns"].as_array().unwrap().len(), read["units"].as_object().unwrap().len());
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing else is left in the folder");
}

#[test]
fn the_benchmark_scripts_explain_themselves() {
    for script in ["compare.py", "collect.py", "pybullet_collect.py", "registry.py"] {
        let help = said(python(&format!("harness/benches/{script}")).arg("--help"));
        assert!(help.contains("idle machine"), "{help}");
    }
}
