//! Progress on the terminal: a bar for each job, or plain lines where the output is no terminal.

use super::interrupt;
use harness::progress::Progress;
use indicatif::{MultiProgress, ProgressBar, ProgressFinish, ProgressStyle};
use std::io::IsTerminal;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Time between two plain lines.
const LINE_INTERVAL: Duration = Duration::from_secs(10);

/// Draws one stage after the other, and those of other jobs beside them. A stage that is over leaves a line.
#[derive(Default)]
pub struct Bars {
    /// The bars of all jobs.
    all: MultiProgress,
    /// Whose stages these are; empty where there is only one job.
    job: String,
    stage: Mutex<Option<Stage>>,
}

struct Stage {
    name: String,
    unit: String,
    /// Hidden where the output is no terminal; it still measures the rate.
    bar: ProgressBar,
    last_line: Instant,
    /// Steps that were done before it began.
    resumed: u64,
}

impl Bars {
    fn stage(&self) -> MutexGuard<'_, Option<Stage>> {
        self.stage.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Prints a line above the bars.
    fn print(&self, line: &str) {
        self.all.suspend(|| eprintln!("{line}"));
    }
}

/// Whether stages are reported in lines, since there is nothing to draw on.
fn lines() -> bool {
    !std::io::stderr().is_terminal()
}

impl Stage {
    fn progress(&self) -> String {
        let (done, total) = (self.bar.position(), self.bar.length().unwrap_or_default());
        let left = indicatif::HumanDuration(self.bar.eta());
        let rate = self.bar.per_sec();
        format!("{}: {done}/{total} {}, {rate:.1}/s, {left:#} left{}", self.name, self.unit, self.note())
    }

    fn end(&self) -> String {
        let seconds = self.bar.elapsed().as_secs_f64();
        let resumed =
            if self.resumed > 0 { format!(", {} of them before,", self.resumed) } else { String::new() };
        format!(
            "{}: {} {}{resumed} in {seconds:.1} s{}",
            self.name,
            self.bar.position(),
            self.unit,
            self.note()
        )
    }

    fn note(&self) -> String {
        let note = self.bar.message();
        if note.is_empty() { note } else { format!(", {note}") }
    }
}

impl Progress for Bars {
    fn begin(&self, name: &str, total: u64, unit: &str) {
        let name = [self.job.as_str(), name].join(" ").trim_start().to_owned();
        let style =
            format!("{{prefix}} {{bar:20}} {{pos}}/{{len}} {unit} {{per_sec}} {{eta}} left {{wide_msg}}");
        let style = ProgressStyle::with_template(&style).unwrap_or_else(|_| ProgressStyle::default_bar());
        let bar = if lines() { ProgressBar::hidden() } else { self.all.add(ProgressBar::no_length()) };
        let bar = bar.with_style(style).with_prefix(name.clone()).with_finish(ProgressFinish::AndClear);
        bar.set_length(total);
        *self.stage() = Some(Stage { name, unit: unit.into(), bar, last_line: Instant::now(), resumed: 0 });
    }

    fn advance(&self, steps: u64) {
        if let Some(stage) = self.stage().as_mut() {
            stage.bar.inc(steps);
            if lines() && stage.last_line.elapsed() >= LINE_INTERVAL {
                self.print(&stage.progress());
                stage.last_line = Instant::now();
            }
        }
    }

    fn resume(&self, steps: u64) {
        if let Some(stage) = self.stage().as_mut() {
            stage.resumed = steps;
            stage.bar.inc(steps);
            // The rate begins here: the bar takes in what was done, and forgets how fast it seemed to be.
            stage.bar.tick();
            stage.bar.reset_eta();
        }
    }

    fn note(&self, text: &str) {
        if let Some(stage) = self.stage().as_mut() {
            stage.bar.set_message(text.to_owned());
        }
    }

    fn say(&self, text: &str) {
        self.print(text);
    }

    fn end(&self) {
        if let Some(stage) = self.stage().take() {
            // Finishing would fill the bar, and training may have stopped early.
            let line = stage.end();
            stage.bar.finish_and_clear();
            self.print(&line);
        }
    }

    fn job(&self, name: &str) -> Option<Box<dyn Progress + '_>> {
        Some(Box::new(Self { all: self.all.clone(), job: name.to_owned(), stage: Mutex::new(None) }))
    }

    fn cancelled(&self) -> bool {
        interrupt::requested()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_leaves_out_what_was_done_before_an_interruption() {
        let bars = Bars::default();
        bars.begin("prediction", 2000, "epochs");
        bars.resume(1000);
        for _ in 0..5 {
            std::thread::sleep(Duration::from_millis(20));
            bars.advance(1);
        }
        let stage = bars.stage();
        let stage = stage.as_ref().unwrap();
        let rate = stage.bar.per_sec();
        // 50 a second at most, and less where sleeping takes longer.
        assert!(rate > 0.0 && rate < 60.0, "{rate} a second: {}", stage.progress());
        assert!(stage.progress().starts_with("prediction: 1005/2000 epochs, "), "{}", stage.progress());
        assert!(
            stage.end().starts_with("prediction: 1005 epochs, 1000 of them before, in 0."),
            "{}",
            stage.end()
        );
    }
}
