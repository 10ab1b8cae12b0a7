//! `harness serve`: the page works in a real browser, follows running trainings, and answers no other site.

use crate::common::{SMOKE, copy_folder, finish, fresh, harness, in_chromium, smoke_run, succeed};
use crate::report::{HOSTILE_PAGE, PENDULUM_PAGE, ROPE_PAGE};
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Command, Stdio};

/// Uses the page of a results folder with tests/python/use_serve.py. Skipped without a browser.
fn use_page(results: &Path, more: &[&str]) {
    let program = Path::new(env!("CARGO_BIN_EXE_harness"));
    if let Some((well, said)) = in_chromium("use_serve.py", &[program, results], more) {
        assert!(well && said.contains("the page works"), "{said}");
        println!("{said}");
    }
}

#[test]
fn a_reader_can_filter_choose_and_ask_in_chromium() {
    let results = smoke_run("serve");
    use_page(&results, &["--live", SMOKE]);
}

#[test]
fn pages_of_other_robots_can_be_used_in_chromium() {
    for results in [&PENDULUM_PAGE.0, &ROPE_PAGE.0] {
        // The page follows changes of the results, which other tests read.
        let copy = fresh(&format!("serve_{}", results.file_name().unwrap().display()));
        copy_folder(results, &copy);
        use_page(&copy, &[]);
    }
}

#[test]
fn a_metric_is_plotted_over_a_setting_in_chromium() {
    let results = fresh("serve_settings");
    let vary = ["vary={training.learning_rate: [0.0001, 0.001, 0.02]}", "seeds=[0,1]", "scenarios=[empty]"];
    let short = ["tasks=[prediction]", "training.epochs=6", "training.patience=null"];
    succeed(&results, &[&["run", SMOKE][..], &vary, &short].concat());
    use_page(&results, &["--settings"]);
}

#[test]
fn served_hostile_text_does_nothing_in_chromium() {
    use_page(&HOSTILE_PAGE.0, &["--hostile"]);
}

/// Takes minutes, because ten thousand runs are written first.
#[test]
#[ignore]
fn ten_thousand_runs_are_served_quickly() {
    let results = fresh("serve_many");
    let program = Path::new(env!("CARGO_BIN_EXE_harness")).with_file_name("examples/many_runs");
    let written = Command::new(program)
        .args(["--results".as_ref(), results.as_os_str()])
        .args(["--seeds", "834", "--epochs", "30"])
        .status();
    assert!(written.unwrap().success());
    // The first query writes the compacted tables.
    succeed(&results, &["query", "select count(*) from metrics"]);
    use_page(&results, &["--many"]);
    std::fs::remove_dir_all(&results).unwrap();
}

#[test]
fn a_used_port_is_an_error_that_says_what_to_do() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    let results = fresh("serve_port");
    std::fs::create_dir_all(results.join("runs")).unwrap();
    // Outside of a clone, where the claims are the built-in ones.
    let answer = finish(harness(&results, &["serve", "--port", &port]).current_dir(&results));
    assert_ne!(answer.code, 0);
    let expected = format!("can't listen on 127.0.0.1:{port}");
    assert!(answer.stderr.contains(&expected) && answer.stderr.contains("--port 0"), "{}", answer.stderr);
}

#[test]
fn the_page_is_served_from_a_folder_without_a_file_of_claims() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir_all(folder.path().join("results/runs")).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_harness"));
    let command = command.current_dir(folder.path()).args(["serve", "--port", "0"]);
    let mut serving = command.stdout(Stdio::piped()).spawn().unwrap();
    let mut said = String::new();
    BufReader::new(serving.stdout.take().unwrap()).read_line(&mut said).unwrap();
    serving.kill().unwrap();
    serving.wait().unwrap();
    assert!(said.starts_with("http://127.0.0.1:"), "{said}");
}
