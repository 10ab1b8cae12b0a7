//! `harness verify`.

use super::progress::Bars;
use super::table::{print_command, print_text};
use super::{DONE, FAILED};
use anyhow::Result;
use harness::numbers::counted;
use harness::registry::Registry;
use std::process::ExitCode;

/// Checks the results folder, and prints every problem with a command that repairs it.
pub fn execute(registry: &Registry) -> Result<ExitCode> {
    let report = registry.verify(&Bars::default());
    for finding in &report.findings {
        let kind = if finding.broken { "broken" } else { "note" };
        print_text(&format!("{kind:<7} {}: {}", finding.path.display(), finding.problem));
        if let Some(mend) = &finding.mend {
            print_command("        repair: ", mend);
        }
    }
    let broken = report.findings.iter().filter(|finding| finding.broken).count();
    let verdict = if broken == 0 { "all files are intact".into() } else { format!("{broken} broken") };
    let [runs, datasets, files] =
        [(report.runs, "run"), (report.datasets, "dataset"), (report.files, "file")]
            .map(|(count, noun)| counted(count, noun));
    print_text(&format!("{runs}, {datasets}, {files}: {verdict}"));
    Ok(ExitCode::from(if broken == 0 { DONE } else { FAILED }))
}
