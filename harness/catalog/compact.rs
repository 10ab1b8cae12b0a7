//! Copies of the tables of many runs in few files, because opening thousands of files takes longer than reading them.
//!
//! ```text
//! results/compacted/<experiment>/<table>-<hash>.parquet
//! ```
//!
//! A part is a file with the rows of several runs. It lists the checksum of each run's own file, and the size, times
//! and inode of that file. A run's rows are read from a part only if the run's record lists the same checksum and its
//! own file has not changed. Otherwise the run's own file is read and compared with the record. Parts are written while
//! tables are read, as soon as enough runs are in no part. A damaged part is written again. The folder can be deleted
//! at any time.

use harness_registry::{FileRecord, Mark, Registry, RegistryError, RunRecord, read_columns};
use harness_shared::files::{FolderLock, sorted};
use harness_shared::seal::hex;
use harness_sql::{Condition, Terms};
use harness_tables::schema::{Column, Table};
use harness_tables::{Stamp, TableFile, asked_columns, stacked, write_table};
use polars::prelude::*;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::any::Any;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::path::PathBuf;

/// The fewest runs of a part: fewer files are as quickly read one by one.
const FEWEST_RUNS: usize = 64;
/// The most runs of a part. A part with half as many is no longer combined with others.
const MOST_RUNS: usize = 256;
/// The largest file whose rows are copied to a part. Opening a larger file takes little time compared with reading it.
const LARGEST_BYTES: u64 = 1 << 18;
/// Key of a part's entries in its file's metadata, as JSON.
const RUNS_KEY: &str = "runs";

/// One table over finished runs of one experiment. Its rows are in the order of the runs.
#[derive(Clone)]
pub struct RunTable {
    table: Table,
    /// The folders of the experiment's runs and of its parts.
    runs: PathBuf,
    parts: PathBuf,
    files: Vec<RunFile>,
    /// Only rows that satisfy at least one of these conditions are read.
    conditions: Arc<BTreeSet<Condition>>,
}

/// A run's file of the table, as its record lists it.
#[derive(Clone)]
struct RunFile {
    run: String,
    listed: FileRecord,
    /// Whether its rows may be copied to a part.
    is_small: bool,
}

/// A run in a part.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Entry {
    run: String,
    sha256: String,
    rows: usize,
    mark: Mark,
}

/// A file with the rows of several runs, in the order of its entries.
struct Part {
    path: PathBuf,
    file: TableFile,
    entries: Vec<Entry>,
}

/// Rows that are read together: those of consecutive runs in a part or in a file of published runs, or those of one
/// run's own file.
#[derive(Clone, Copy)]
struct Segment {
    place: Place,
    offset: usize,
    rows: usize,
}

#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Place {
    Part(usize),
    /// The file of a run. That of published runs is the file of the first one.
    File(usize),
}

impl RunTable {
    /// Returns the table over `runs`, all of which must be finished runs of `experiment`.
    ///
    /// A published run without rows of the table has no file of it.
    ///
    /// # Errors
    /// When the record of a run that is not published does not list the table's file.
    pub fn new<'a>(
        registry: &Registry,
        table: Table,
        experiment: &str,
        runs: impl Iterator<Item = &'a RunRecord>,
    ) -> Result<Self, RegistryError> {
        let folder = registry.runs().join(experiment);
        let name = table.file_name();
        let runs = runs.filter(|record| record.has(table));
        let file = |record: &RunRecord| {
            let own = folder.join(&record.run);
            let listed = record.listed(&own, &name)?.settled(&own.join(&name));
            let is_small = listed.bytes <= LARGEST_BYTES && listed.slice.is_none();
            Ok(RunFile { run: record.run.clone(), listed, is_small })
        };
        let files = runs.map(file).collect::<Result<_, RegistryError>>()?;
        let parts = registry.compacted(experiment);
        Ok(Self { table, runs: folder, parts, files, conditions: Arc::default() })
    }

    /// Returns the table with only those rows that satisfy at least one of these conditions.
    pub fn only(self, conditions: BTreeSet<Condition>) -> Self {
        Self { conditions: Arc::new(conditions), ..self }
    }

    /// Returns the names and types of the files' columns, or nothing if no run has a file of the table.
    pub fn schema(&self) -> PolarsResult<SchemaRef> {
        let columns: Vec<String> = self.table.columns().into_iter().map(|column| column.name).collect();
        let Some(first) = self.files.first() else { return Ok(SchemaRef::default()) };
        Ok(self.read_file(first, &columns, Some((0, 0)))?.schema().clone())
    }

    /// Reads these columns of all rows that satisfy the conditions. With a limit, only the first `limit` rows are
    /// compared with the conditions.
    ///
    /// # Errors
    /// When a file is damaged. The error wraps a [`RegistryError`], which [`QueryError`](super::QueryError) unwraps.
    pub fn read(&self, columns: &[String], limit: Option<usize>) -> PolarsResult<DataFrame> {
        Ok(stacked(self.map(columns, limit, Ok)?)?.unwrap_or_default())
    }

    /// Applies `of` to these columns, piece by piece, and returns the results in the order of the runs. A piece has all
    /// rows of one or several runs that satisfy the conditions; with a limit, the last piece has fewer.
    pub fn map<T: Send>(
        &self,
        columns: &[String],
        limit: Option<usize>,
        of: impl Fn(DataFrame) -> PolarsResult<T> + Sync,
    ) -> PolarsResult<Vec<T>> {
        let of_conditions: BTreeSet<&String> = self.conditions.iter().flat_map(BTreeMap::keys).collect();
        let others = of_conditions.into_iter().filter(|name| !columns.contains(name));
        let needed: Vec<String> = columns.iter().chain(others).cloned().collect();
        let wanted = |rows: &DataFrame| Terms::default().wanted(rows, &self.conditions);
        let cut = |rows: &DataFrame, wanted: Option<&BooleanChunked>, segment: &Segment| {
            let (offset, length) = (segment.offset as i64, segment.rows);
            let piece = rows.slice(offset, length).select(columns)?;
            of(match wanted {
                // Polars' threads read the files. While such a thread waits for a parallel filter, it begins with the
                // next file, until all of them are in memory.
                Some(wanted) => piece.filter_seq(&wanted.slice(offset, length))?,
                None => piece,
            })
        };
        let (parts, places) = self.places();
        let mut of_places: BTreeMap<Place, Vec<(usize, Segment)>> = BTreeMap::new();
        for (index, segment) in self.segments(&places, limit).into_iter().enumerate() {
            of_places.entry(segment.place).or_default().push((index, segment));
        }
        let of_place = |(place, segments): (Place, Vec<(usize, Segment)>)| -> PolarsResult<Vec<(usize, T)>> {
            let rows = match place {
                Place::Part(part) => parts[part].file.read_serially(&needed).map_err(RegistryError::from)?,
                Place::File(file) => self.read_file(&self.files[file], &needed, None)?,
            };
            let wanted = wanted(&rows)?;
            let segments = segments.iter();
            segments.map(|(index, segment)| Ok((*index, cut(&rows, wanted.as_ref(), segment)?))).collect()
        };
        let made: Vec<_> = of_places.into_par_iter().map(of_place).collect::<PolarsResult<_>>()?;
        let mut all: Vec<(usize, T)> = made.into_iter().flatten().collect();
        all.sort_by_key(|(index, _)| *index);
        Ok(all.into_iter().map(|(_, made)| made).collect())
    }

    /// Returns the existing parts, and the place of each run in them, if it is in one. If enough runs are in no part,
    /// they are put into one first.
    fn places(&self) -> (Vec<Part>, Vec<Option<Segment>>) {
        if self.files.len() < FEWEST_RUNS {
            return (Vec::new(), vec![None; self.files.len()]);
        }
        let marks: Vec<Option<Mark>> =
            self.files.par_iter().map(|file| Mark::of(&self.path(&file.run))).collect();
        let parts = self.read_parts();
        let places = self.find(&parts, &marks);
        let loose: Vec<Entry> = (self.files.iter().zip(&marks).zip(&places))
            .filter(|((file, _), place)| file.is_small && place.is_none())
            .filter_map(|((file, mark), _)| Some(file.entry(mark.filter(Mark::is_settled)?)))
            .collect();
        if loose.len() < FEWEST_RUNS || !self.compact(loose) {
            return (parts, places);
        }
        let parts = self.read_parts();
        let places = self.find(&parts, &marks);
        (parts, places)
    }

    fn find(&self, parts: &[Part], marks: &[Option<Mark>]) -> Vec<Option<Segment>> {
        let wanted: HashMap<&str, usize> =
            self.files.iter().enumerate().map(|(index, file)| (file.run.as_str(), index)).collect();
        let mut places = vec![None; self.files.len()];
        for (number, part) in parts.iter().enumerate() {
            let mut offset = 0;
            for entry in &part.entries {
                if let Some(&index) = wanted.get(entry.run.as_str())
                    && self.files[index].listed.sha256 == entry.sha256
                    && marks[index] == Some(entry.mark)
                {
                    places[index] = Some(Segment { place: Place::Part(number), offset, rows: entry.rows });
                }
                offset += entry.rows;
            }
        }
        places
    }

    /// Returns the runs' rows in as few pieces as possible. With a limit, the pieces have only the first rows.
    fn segments(&self, places: &[Option<Segment>], limit: Option<usize>) -> Vec<Segment> {
        let mut segments: Vec<Segment> = Vec::new();
        let mut left = limit.unwrap_or(usize::MAX);
        let first_slice = self.files.iter().position(|file| file.listed.slice.is_some()).unwrap_or_default();
        for (index, (file, place)) in self.files.iter().zip(places).enumerate() {
            let rows = file.listed.rows.unwrap_or(usize::MAX);
            let own = match &file.listed.slice {
                Some(slice) => Segment { place: Place::File(first_slice), offset: slice.offset, rows },
                None => Segment { place: Place::File(index), offset: 0, rows },
            };
            let mut next = place.unwrap_or(own);
            next.rows = next.rows.min(left);
            if limit.is_some() {
                left -= next.rows;
            }
            // At least one piece is needed, because it defines the columns.
            let is_needed = next.rows > 0 || segments.is_empty();
            match segments.last_mut() {
                Some(last) if last.place == next.place && last.offset + last.rows == next.offset => {
                    last.rows += next.rows;
                }
                _ if is_needed => segments.push(next),
                _ => {}
            }
        }
        segments
    }

    /// Returns the undamaged parts of this table.
    fn read_parts(&self) -> Vec<Part> {
        let columns = described(&self.table.columns());
        self.part_files().into_par_iter().filter_map(|path| Part::open(path, &columns)).collect()
    }

    /// Returns the files of all parts of this table.
    fn part_files(&self) -> Vec<PathBuf> {
        let prefix = format!("{}-", self.table.name());
        let is_own = |path: &PathBuf| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            name.starts_with(&prefix) && name.ends_with(".parquet")
        };
        sorted(&self.parts).into_iter().filter(is_own).collect()
    }

    /// Puts the rows of `loose` runs into parts, together with the rows of parts that are small, partly outdated or
    /// damaged. Returns whether it did so. It does not if another process is doing it, or if the folder can't be
    /// written. Reading then takes longer, but gives the same rows.
    fn compact(&self, loose: Vec<Entry>) -> bool {
        let Ok(Some(_lock)) = FolderLock::attempt(&self.parts) else { return false };
        let is_current = |entry: &&Entry| Mark::of(&self.path(&entry.run)) == Some(entry.mark);
        let mut kept = HashSet::new();
        let mut pool: BTreeMap<String, Entry> = BTreeMap::new();
        for part in self.read_parts() {
            let current: Vec<Entry> = part.entries.iter().filter(is_current).cloned().collect();
            if current.len() >= MOST_RUNS / 2 {
                kept.insert(part.path);
            } else {
                pool.extend(current.into_iter().map(|entry| (entry.run.clone(), entry)));
            }
        }
        pool.extend(loose.into_iter().map(|entry| (entry.run.clone(), entry)));
        let pool: Vec<Entry> = pool.into_values().collect();
        let parts = pool.len().div_ceil(MOST_RUNS);
        for runs in pool.chunks(pool.len().div_ceil(parts)) {
            match self.write_part(runs) {
                Ok(path) => drop(kept.insert(path)),
                Err(_) => return false,
            }
        }
        for path in self.part_files().into_iter().filter(|path| !kept.contains(path)) {
            // A file that can't be removed only costs space and time.
            let _ = std::fs::remove_file(path);
        }
        true
    }

    /// Writes a part with the rows of these runs. Their own files are read and compared with the checksums.
    fn write_part(&self, runs: &[Entry]) -> PolarsResult<PathBuf> {
        let columns = self.table.columns();
        let names: Vec<String> = columns.iter().map(|column| column.name.clone()).collect();
        let read = |entry: &Entry| -> PolarsResult<(Entry, DataFrame)> {
            let rows = self.read_file(&RunFile::of(entry), &names, None)?;
            Ok((Entry { rows: rows.height(), ..entry.clone() }, rows))
        };
        let read: Vec<_> = runs.par_iter().map(read).collect::<PolarsResult<_>>()?;
        let (entries, rows): (Vec<Entry>, Vec<DataFrame>) = read.into_iter().unzip();
        let entries = serde_json::to_string(&entries)
            .map_err(|error| PolarsError::ComputeError(error.to_string().into()))?;
        let name = format!("{}-{}.parquet", self.table.name(), hex(&Sha256::digest(&entries)[..8]));
        let path = self.parts.join(name);
        let rows = stacked(rows)?.unwrap_or_default();
        let stamp = Stamp::from([(RUNS_KEY.to_owned(), entries)]);
        write_table(&path, rows, &columns, &stamp).map_err(RegistryError::from)?;
        Ok(path)
    }

    /// Reads these columns of a run's file, which is compared with its record. A file of published runs has the rows of
    /// all of them.
    fn read_file(
        &self,
        file: &RunFile,
        columns: &[String],
        rows: Option<(usize, usize)>,
    ) -> PolarsResult<DataFrame> {
        let path = self.path(&file.run);
        let bytes = file.listed.read(&path)?;
        Ok(read_columns(&bytes, columns, rows)
            .map_err(|error| RegistryError::File { path, reason: error.to_string() })?)
    }

    fn path(&self, run: &str) -> PathBuf {
        self.runs.join(run).join(self.table.file_name())
    }
}

/// The table as a source of Polars, which reads only the columns that a query uses.
impl AnonymousScan for RunTable {
    fn as_any(&self) -> &dyn Any {
        self
    }

    fn scan(&self, asked: AnonymousScanArgs) -> PolarsResult<DataFrame> {
        self.read(&asked_columns(&asked), asked.n_rows)
    }

    // Polars filters the rows that it gets. It can't pass every filter to a scan of this kind.
    fn allows_predicate_pushdown(&self) -> bool {
        false
    }

    fn allows_projection_pushdown(&self) -> bool {
        true
    }
}

impl RunFile {
    fn entry(&self, mark: Mark) -> Entry {
        let (run, sha256) = (self.run.clone(), self.listed.sha256.clone());
        Entry { run, sha256, rows: self.listed.rows.unwrap_or_default(), mark }
    }

    fn of(entry: &Entry) -> Self {
        let listed = FileRecord {
            bytes: entry.mark.bytes,
            rows: Some(entry.rows),
            sha256: entry.sha256.clone(),
            next: None,
            slice: None,
        };
        Self { run: entry.run.clone(), listed, is_small: true }
    }
}

impl Part {
    /// Opens a part. Returns `None` if it is damaged or has other columns.
    fn open(path: PathBuf, columns: &str) -> Option<Self> {
        let file = TableFile::open(&path).ok()?;
        let footer = file.footer().ok()?;
        let entries: Vec<Entry> = serde_json::from_str(footer.stamp.get(RUNS_KEY)?).ok()?;
        let rows: usize = entries.iter().map(|entry| entry.rows).sum();
        let is_current = footer.stamp.get("columns")? == columns && rows == footer.rows;
        is_current.then_some(Self { path, file, entries })
    }
}

/// The columns as in a file's metadata.
fn described(columns: &[Column]) -> String {
    serde_json::to_string(columns).unwrap_or_default()
}
