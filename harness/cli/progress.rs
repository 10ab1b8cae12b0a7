//! Progress on the terminal: bars, or plain lines where the output is no terminal.

use harness::progress::Progress;
use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// Time between two plain lines.
const LINE_INTERVAL: Duration = Duration::from_secs(10);

/// Draws one stage after the other.
#[derive(Default)]
pub struct Bars {
    stage: Mutex<Option<Stage>>,
}

struct Stage {
    name: String,
    unit: String,
    /// Hidden where the output is no terminal; it still measures the rate.
    bar: ProgressBar,
    lines: bool,
    last_line: Instant,
}

impl Bars {
    fn with_stage(&self, act: impl FnOnce(&mut Stage)) {
        let mut stage = self.stage.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        if let Some(stage) = stage.as_mut() {
            act(stage);
        }
    }
}

impl Stage {
    fn line(&self) {
        let (done, total) = (self.bar.position(), self.bar.length().unwrap_or_default());
        let left = indicatif::HumanDuration(self.bar.eta());
        let note = self.bar.message();
        let note = if note.is_empty() { note } else { format!(", {note}") };
        eprintln!(
            "{}: {done}/{total} {}, {:.1}/s, {left:#} left{note}",
            self.name,
            self.unit,
            self.bar.per_sec()
        );
    }
}

impl Progress for Bars {
    fn begin(&self, name: &str, total: u64, unit: &str) {
        let lines = !std::io::stderr().is_terminal();
        let bar = if lines { ProgressBar::hidden() } else { ProgressBar::no_length() };
        let style =
            format!("{{prefix}} {{bar:20}} {{pos}}/{{len}} {unit} {{per_sec}} {{eta}} left {{wide_msg}}");
        let style = ProgressStyle::with_template(&style).unwrap_or_else(|_| ProgressStyle::default_bar());
        let bar = bar.with_style(style).with_prefix(name.to_owned());
        bar.set_length(total);
        let stage = Stage { name: name.into(), unit: unit.into(), bar, lines, last_line: Instant::now() };
        *self.stage.lock().unwrap_or_else(|poisoned| poisoned.into_inner()) = Some(stage);
    }

    fn advance(&self, steps: u64) {
        self.with_stage(|stage| {
            stage.bar.inc(steps);
            if stage.lines && stage.last_line.elapsed() >= LINE_INTERVAL {
                stage.line();
                stage.last_line = Instant::now();
            }
        });
    }

    fn note(&self, text: &str) {
        self.with_stage(|stage| stage.bar.set_message(text.to_owned()));
    }

    fn say(&self, text: &str) {
        let mut stage = self.stage.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        match stage.as_mut().filter(|stage| !stage.lines) {
            Some(stage) => stage.bar.println(text),
            None => eprintln!("{text}"),
        }
    }

    fn end(&self) {
        self.with_stage(|stage| {
            if stage.lines {
                eprintln!(
                    "{}: {} {} in {:.1} s{}",
                    stage.name,
                    stage.bar.position(),
                    stage.unit,
                    stage.bar.elapsed().as_secs_f64(),
                    if stage.bar.message().is_empty() {
                        String::new()
                    } else {
                        format!(", {}", stage.bar.message())
                    }
                );
            }
            stage.bar.finish();
        });
        *self.stage.lock().unwrap_or_else(|poisoned| poisoned.into_inner()) = None;
    }
}
