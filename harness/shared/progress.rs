//! Progress of long work. The library only reports it, and the command line displays it.

/// Receives the progress of one command. Several threads may call it.
pub trait Progress: Sync {
    /// A stage of `total` steps begins. `unit` names the steps, such as "samples" or "epochs".
    fn begin(&self, stage: &str, total: u64, unit: &str);
    /// `steps` more steps are done.
    fn advance(&self, steps: u64);
    /// `done` of `of` parts of the next step are done.
    fn part(&self, _done: u64, _of: u64) {}
    /// `steps` of the stage were done before it began, by an earlier process.
    fn resume(&self, steps: u64) {
        self.advance(steps);
    }
    /// Shows a short note on the current stage, such as the latest losses. It replaces the previous note.
    fn note(&self, text: &str);
    /// Shows a message that stays visible after the stage has ended.
    fn say(&self, text: &str);
    /// The current stage ends.
    fn end(&self);
    /// Returns the progress of one of several simultaneous jobs, by its name. With `None`, the job reports here.
    fn job(&self, _name: &str) -> Option<Box<dyn Progress + '_>> {
        None
    }
    /// Whether the caller wants the work to stop at the next step.
    fn cancelled(&self) -> bool {
        false
    }
}

/// Ignores all reports.
pub struct Silent;

impl Progress for Silent {
    fn begin(&self, _stage: &str, _total: u64, _unit: &str) {}
    fn advance(&self, _steps: u64) {}
    fn note(&self, _text: &str) {}
    fn say(&self, _text: &str) {}
    fn end(&self) {}
}
