//! Progress on the terminal: a bar for each job, or plain lines if the standard error is no terminal.

use super::encoding::IS_UTF8;
use super::interrupt;
use harness::numbers::duration;
use harness::progress::Progress;
use indicatif::{MultiProgress, ProgressBar, ProgressFinish, ProgressStyle};
use std::io::IsTerminal;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use terminal_size::terminal_size_of;

/// Time between two plain lines.
const LINE_INTERVAL: Duration = Duration::from_secs(10);

/// Time between two changes of a bar by parts of a step.
const PART_INTERVAL: Duration = Duration::from_millis(100);

/// Terminals with fewer characters have no room for a bar.
const NARROW: u16 = 80;

/// Draws a bar for the current stage of each job on the standard error. A line remains of each finished stage.
#[derive(Default)]
pub struct Bars {
    /// The bars of all jobs.
    all: MultiProgress,
    /// The name of this job; empty if there is only one.
    job: String,
    stage: Mutex<Option<Stage>>,
}

struct Stage {
    name: String,
    unit: String,
    /// The latest note, or nothing.
    note: String,
    /// The bar, which is hidden if the output is no terminal. It counts the steps in any case.
    bar: ProgressBar,
    /// Number of characters of a line that the name and the bar take.
    taken: usize,
    /// When the last line was printed, or the bar last changed.
    last_shown: Instant,
    /// Number of steps that were done before this process started.
    resumed: u64,
    /// The share of the next step that is done.
    part: f64,
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

/// The width of the terminal in characters, or `None` if the standard error is no terminal.
fn width() -> Option<u16> {
    terminal_size_of(std::io::stderr()).map(|(width, _)| width.0)
}

/// Whether progress is printed in lines, because the standard error is no terminal.
fn lines() -> bool {
    !std::io::stderr().is_terminal()
}

impl Stage {
    /// A line about the running stage. The note comes first, because it is the most important part.
    fn progress(&self) -> String {
        sentence(&self.parts().map(|(part, _)| part))
    }

    /// What is known about the running stage, in the order in which it is shown. The number is the part's rank: if
    /// there is not enough room, those with the highest ranks are left out.
    fn parts(&self) -> [(String, u8); 5] {
        let (done, total) = (self.bar.position(), self.bar.length().unwrap_or_default());
        let (own, left) = ((done - self.resumed) as f64, total.saturating_sub(done) as f64);
        let (rate, left) = pace(own + self.part, left - self.part, self.bar.elapsed());
        let (main, details) = self.note.split_once(", ").unwrap_or((&self.note, ""));
        [
            (main.to_owned(), 0),
            (details.to_owned(), 4),
            (format!("{done}/{total} {}", self.units(total)), 1),
            (rate, 3),
            (left, 2),
        ]
    }

    /// As many parts of the line as have room in `limit` characters.
    fn fitting(&self, limit: usize) -> String {
        let parts = self.parts();
        let with = |most: u8| {
            let parts = parts.iter().filter(|(_, rank)| *rank <= most);
            sentence(&parts.map(|(part, _)| part.as_str()).collect::<Vec<_>>())
        };
        // Without the unit, the number of steps may have room even beside a long name.
        let count = format!("{}/{}", self.bar.position(), self.bar.length().unwrap_or_default());
        let mut lines = (1..parts.len() as u8).rev().map(with).chain([sentence(&[&parts[0].0, &count])]);
        lines.find(|line| line.chars().count() <= limit).unwrap_or_else(|| with(0))
    }

    /// Shows how far the stage is, in a line if the last one was printed long ago.
    fn show(&mut self, print: impl Fn(&str)) {
        if !lines() {
            let room = usize::from(width().unwrap_or(NARROW)).saturating_sub(self.taken);
            self.bar.set_message(self.fitting(room));
        } else if self.last_shown.elapsed() >= LINE_INTERVAL {
            print(&format!("{}: {}", self.name, self.progress()));
        } else {
            return;
        }
        self.last_shown = Instant::now();
    }

    /// The unit of so many steps: `run` or `runs`.
    fn units(&self, count: u64) -> &str {
        if count == 1 { self.unit.strip_suffix('s').unwrap_or(&self.unit) } else { &self.unit }
    }

    fn end(&self) -> String {
        let seconds = self.bar.elapsed().as_secs_f64();
        let resumed =
            if self.resumed > 0 { format!(", {} of them before,", self.resumed) } else { String::new() };
        let done = self.bar.position();
        let done = format!("{done} {}{resumed} in {seconds:.1} s", self.units(done));
        format!("{}: {}", self.name, sentence(&[&done, &self.note]))
    }
}

/// Joins the parts that are not empty with commas.
fn sentence(parts: &[impl AsRef<str>]) -> String {
    let parts = parts.iter().map(AsRef::as_ref).filter(|part| !part.is_empty());
    parts.collect::<Vec<_>>().join(", ")
}

/// The average pace of `done` steps in `elapsed`, and the estimated time of the steps that are left.
fn pace(done: f64, left: f64, elapsed: Duration) -> (String, String) {
    if done == 0.0 {
        return Default::default();
    }
    let each = elapsed.as_secs_f64().max(1e-6) / done;
    let rate = if each < 1.0 { format!("{:.1}/s", 1.0 / each) } else { format!("{each:.1} s each") };
    (rate, format!("{} left", duration(each * left)))
}

impl Progress for Bars {
    fn begin(&self, name: &str, total: u64, unit: &str) {
        let name = [self.job.as_str(), name].join(" ").trim_start().to_owned();
        let bar = if lines() { ProgressBar::hidden() } else { self.all.add(ProgressBar::no_length()) };
        let (template, around) = match width().is_some_and(|width| width < NARROW) {
            true => ("{prefix} {wide_msg}", 1),
            false => ("{prefix} {bar:10} {wide_msg}", 12),
        };
        let taken = name.chars().count() + around;
        let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
        let style = if *IS_UTF8 { style } else { style.progress_chars("#-") };
        let bar = bar.with_style(style).with_prefix(name.clone()).with_finish(ProgressFinish::AndClear);
        bar.set_length(total);
        let (unit, note, last_shown) = (unit.into(), String::new(), Instant::now());
        *self.stage() = Some(Stage { name, unit, note, bar, taken, last_shown, resumed: 0, part: 0.0 });
    }

    fn advance(&self, steps: u64) {
        if let Some(stage) = self.stage().as_mut() {
            stage.bar.inc(steps);
            stage.part = 0.0;
            stage.show(|line| self.print(line));
        }
    }

    fn part(&self, done: u64, of: u64) {
        if let Some(stage) = self.stage().as_mut() {
            stage.part = done as f64 / of as f64;
            if stage.last_shown.elapsed() >= PART_INTERVAL {
                stage.show(|line| self.print(line));
            }
        }
    }

    fn resume(&self, steps: u64) {
        if let Some(stage) = self.stage().as_mut() {
            stage.resumed = steps;
            stage.bar.set_position(steps);
        }
    }

    fn note(&self, text: &str) {
        if let Some(stage) = self.stage().as_mut() {
            stage.note = text.to_owned();
        }
    }

    fn say(&self, text: &str) {
        self.print(text);
    }

    fn end(&self) {
        if let Some(stage) = self.stage().take() {
            // The line is made first: finishing the bar sets it to its length, but training may have stopped early.
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
    fn what_is_left_goes_by_the_steps_so_far() {
        let pace = |done, left, seconds| {
            let (rate, left) = pace(done, left, Duration::from_secs(seconds));
            sentence(&[rate, left])
        };
        assert_eq!(pace(0.0, 10.0, 5), "");
        assert_eq!(pace(4.0, 10.0, 120), "30.0 s each, 5 min left");
        assert_eq!(pace(500.0, 1000.0, 10), "50.0/s, 20 s left");
        assert_eq!(pace(0.25, 9.5, 10), "40.0 s each, 6 min left");
    }

    #[test]
    fn the_time_left_is_told_in_the_first_step() {
        let bars = Bars::default();
        bars.begin("prediction", 100, "epochs");
        let said = || bars.stage().as_ref().unwrap().progress();
        assert_eq!(said(), "0/100 epochs");
        std::thread::sleep(Duration::from_millis(20));
        bars.part(1, 4);
        let told = said();
        assert!(told.starts_with("0/100 epochs, ") && told.ends_with(" left"), "{told}");
        // A step that is done has no part.
        bars.part(4, 4);
        bars.advance(1);
        assert_eq!(bars.stage().as_ref().unwrap().part, 0.0);
        assert!(said().starts_with("1/100 epochs, "), "{}", said());
    }

    #[test]
    fn the_loss_has_room_first_then_the_epochs_then_the_time() {
        let bars = Bars::default();
        bars.begin("prediction", 200, "epochs");
        bars.advance(12);
        bars.note("validation 0.4210, lowest 0.4100 in epoch 9, training 0.3900");
        let stage = bars.stage();
        let stage = stage.as_ref().unwrap();
        let all = stage.fitting(200);
        assert!(
            all.starts_with("validation 0.4210, lowest 0.4100 in epoch 9, training 0.3900, 12/200 epochs, ")
        );
        assert!(all.ends_with(" left"), "{all}");
        assert!(
            stage.fitting(60).starts_with("validation 0.4210, 12/200 epochs, ")
                && stage.fitting(60).ends_with(" left")
        );
        assert_eq!(stage.fitting(32), "validation 0.4210, 12/200 epochs");
        assert_eq!(stage.fitting(31), "validation 0.4210, 12/200");
        assert_eq!(stage.fitting(24), "validation 0.4210");
    }

    #[test]
    fn the_rate_leaves_out_what_was_done_before_an_interruption() {
        let bars = Bars::default();
        bars.begin("prediction", 2000, "epochs");
        bars.resume(1000);
        for _ in 0..5 {
            std::thread::sleep(Duration::from_millis(20));
            bars.advance(1);
        }
        bars.note("validation 0.5");
        let stage = bars.stage();
        let stage = stage.as_ref().unwrap();
        let said = stage.progress();
        let rest =
            said.strip_prefix("validation 0.5, 1005/2000 epochs, ").unwrap_or_else(|| panic!("{said}"));
        // The rate is at most 50 per second, and less if sleeping takes longer.
        let (rate, _) = rest.split_once(", ").unwrap();
        let rate = rate.strip_suffix("/s").map_or(0.0, |rate| rate.parse::<f64>().unwrap());
        assert!(rate < 60.0, "{said}");
        let end = stage.end();
        assert!(end.starts_with("prediction: 1005 epochs, 1000 of them before, in "), "{end}");
        assert!(end.ends_with(" s, validation 0.5"), "{end}");
    }
}
