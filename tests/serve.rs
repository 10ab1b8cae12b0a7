//! `harness serve`: the page works in a real browser, follows running trainings, and answers no other site.

use crate::common::{SMOKE, fresh, smoke_run, succeed};
use crate::report::{HOSTILE_PAGE, browser};
use std::net::TcpListener;
use std::path::Path;
use std::process::Command;

/// Uses the page of a results folder with tests/python/use_serve.py. Skipped without a browser.
fn use_page(results: &Path, more: &[&str]) {
    let Ok((chromium, driver)) = browser().inspect_err(|reason| eprintln!("{reason}")) else { return };
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let output = Command::new(root.join(".venv/bin/python"))
        .arg(root.join("tests/python/use_serve.py"))
        .arg(env!("CARGO_BIN_EXE_harness"))
        .args([results, &chromium, &driver])
        .args(more)
        .current_dir(root)
        .output()
        .unwrap();
    let said =
        [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    assert!(output.status.success() && said.contains("the page works"), "{said}");
    println!("{said}");
}

#[test]
fn a_reader_can_filter_choose_and_ask_in_chromium() {
    let results = smoke_run("serve");
    use_page(&results, &["--live", SMOKE]);
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
    let answer = crate::common::finish(&mut crate::common::harness(&results, &["serve", "--port", &port]));
    assert_ne!(answer.code, 0);
    let expected = format!("can't listen on 127.0.0.1:{port}");
    assert!(answer.stderr.contains(&expected) && answer.stderr.contains("--port 0"), "{}", answer.stderr);
}
