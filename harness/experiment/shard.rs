//! Shares of a list of work, so that several processes can divide it without talking to each other.

use std::fmt;
use std::str::FromStr;

/// One of several shares of a list: every `count`-th item, from the `number`-th on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    /// 1 to `count`.
    number: usize,
    count: usize,
}

impl Shard {
    /// The most shares of a list.
    pub const MOST: usize = 100_000;

    /// Whether the item at `index` (from 0) belongs to this share.
    pub fn contains(self, index: usize) -> bool {
        index % self.count == self.number - 1
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, to: &mut fmt::Formatter) -> fmt::Result {
        write!(to, "{}/{}", self.number, self.count)
    }
}

/// A text that names no share.
#[derive(Debug, thiserror::Error)]
#[error("a shard is I/N, with I from 1 to N and N up to {}, for example 3/8", Shard::MOST)]
pub struct ShardError;

impl FromStr for Shard {
    type Err = ShardError;

    fn from_str(text: &str) -> Result<Self, ShardError> {
        let (number, count) = text.split_once('/').ok_or(ShardError)?;
        let number: usize = number.parse().map_err(|_| ShardError)?;
        let count: usize = count.parse().map_err(|_| ShardError)?;
        let is_share = (1..=count).contains(&number) && count <= Self::MOST;
        is_share.then_some(Self { number, count }).ok_or(ShardError)
    }
}
