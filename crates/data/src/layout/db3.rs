//! rosbag2 files of SQLite: a table `topics` and a table `messages`.
//!
//! A file is opened as one that does not change (`immutable`): SQLite then neither locks it nor writes beside it.

use super::bag::{BagFile, Bags, CLOUD, ODOMETRY, Place, TF, Topic, Visit};
use crate::{DataError, Layout, absolute};
use rusqlite::types::{FromSql, Value};
use rusqlite::{Connection, OpenFlags, Row, Statement};
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Clouds in SQLite files.
#[allow(non_upper_case_globals, reason = "a line of `layouts!`")]
pub(super) const Db3: Bags = Bags {
    layout: Layout::Db3,
    name: "db3",
    extension: "db3",
    markers: &["*.db3 (ROS 2)"],
    check: check_closed,
    open: |path| Ok(Box::new(Recording::open(path)?)),
};

/// Fewest bytes of a row of `messages` in a file.
const LEAST_ROW_BYTES: u64 = 8;

/// An open file with the places of its messages.
struct Recording {
    path: PathBuf,
    connection: Mutex<Connection>,
    topics: Vec<Topic>,
    /// Of the topics: number of the topic, and place.
    messages: Vec<(i64, Place)>,
}

impl Recording {
    /// # Errors
    /// A file that is no recording of rosbag2, is damaged, or was not closed by its recorder.
    fn open(path: &Path) -> Result<Recording, DataError> {
        let wrong = |e: rusqlite::Error| {
            let advice = "if the file was damaged, `sqlite3 FILE .recover` saves what can be read";
            DataError::file(path, format!("is no rosbag2 recording in SQLite: {e}; {advice}"))
        };
        let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX | OpenFlags::SQLITE_OPEN_URI;
        let connection = Connection::open_with_flags(address(path)?, flags).map_err(wrong)?;
        // Functions in the schema of a foreign file are not called.
        connection.pragma_update(None, "trusted_schema", false).map_err(wrong)?;
        let tables = "SELECT count(*) FROM sqlite_schema WHERE type = 'table' AND name IN ('topics', 'messages')";
        if connection.query_row(tables, [], |row| row.get::<_, i64>(0)).map_err(wrong)? != 2 {
            let message = "is no rosbag2 recording: it lacks the table topics or the table messages; check `root`";
            return Err(DataError::file(path, message));
        }
        let mut recording =
            Recording { path: path.into(), connection: Mutex::new(connection), topics: vec![], messages: vec![] };
        let topics = recording.topics_of_table()?;
        recording.topics = topics.into_iter().filter(|t| [CLOUD, TF, ODOMETRY].contains(&t.kind.as_str())).collect();
        recording.messages = recording.messages_of_table()?;
        Ok(recording)
    }

    fn connection(&self) -> MutexGuard<'_, Connection> {
        self.connection.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn topics_of_table(&self) -> Result<Vec<Topic>, DataError> {
        let connection = self.connection();
        let mut topics = Vec::new();
        let mut found =
            self.prepared(&connection, "topics", "SELECT id, name, type, serialization_format FROM topics")?;
        let mut rows = found.query([]).map_err(|e| self.wrong("topics", e))?;
        while let Some(row) = rows.next().map_err(|e| self.wrong("topics", e))? {
            let text = |column: usize| self.value::<String>("topics", row, column);
            let channel = self.value("topics", row, 0)?;
            topics.push(Topic { channel, name: text(1)?, kind: text(2)?, encoding: text(3)? });
        }
        Ok(topics)
    }

    /// The messages of the topics, in any order.
    fn messages_of_table(&self) -> Result<Vec<(i64, Place)>, DataError> {
        let connection = self.connection();
        let most = fs_err::metadata(&self.path)?.len() / LEAST_ROW_BYTES;
        let (mut messages, mut count) = (Vec::new(), 0);
        let mut found = self.prepared(&connection, "messages", "SELECT id, topic_id, timestamp FROM messages")?;
        let mut rows = found.query([]).map_err(|e| self.wrong("messages", e))?;
        while let Some(row) = rows.next().map_err(|e| self.wrong("messages", e))? {
            count += 1;
            if count > most {
                return Err(self.wrong("messages", "it has more rows than the file can hold: the file is damaged"));
            }
            let topic: i64 = self.value("messages", row, 1)?;
            if self.topics.iter().any(|t| t.channel == topic) {
                let (number, log_time) = (self.value("messages", row, 0)?, self.value("messages", row, 2)?);
                messages.push((topic, Place { log_time, chunk: 0, number }));
            }
        }
        Ok(messages)
    }

    fn prepared<'a>(&self, connection: &'a Connection, table: &str, query: &str) -> Result<Statement<'a>, DataError> {
        connection.prepare(query).map_err(|e| self.wrong(table, e))
    }

    /// The value of a column, of which the first is the id.
    fn value<T: FromSql>(&self, table: &str, row: &Row, column: usize) -> Result<T, DataError> {
        row.get(column).map_err(|e| {
            let id = match row.get::<_, Value>(0) {
                Ok(Value::Integer(id)) => id.to_string(),
                _ => "unknown".into(),
            };
            self.wrong(table, format!("row with the id {id}: {e}"))
        })
    }

    fn wrong(&self, table: &str, message: impl std::fmt::Display) -> DataError {
        DataError::file(&self.path, format!("its table {table} cannot be read: {message}"))
    }

    /// The data of the message with an id.
    fn data(&self, query: &mut Statement, id: i64) -> Result<Vec<u8>, DataError> {
        let wrong = |e| self.wrong("messages", format!("row with the id {id}: {e}"));
        query.query_row([id], |row| row.get(0)).map_err(wrong)
    }
}

const DATA: &str = "SELECT data FROM messages WHERE id = ?1";

impl BagFile for Recording {
    fn topics(&self) -> Vec<Topic> {
        self.topics.clone()
    }

    fn places(&self, channel: i64) -> Result<Vec<Place>, DataError> {
        Ok(self.messages.iter().filter(|(topic, _)| *topic == channel).map(|(_, place)| *place).collect())
    }

    fn message(&self, _channel: i64, place: Place) -> Result<Vec<u8>, DataError> {
        let connection = self.connection();
        self.data(&mut self.prepared(&connection, "messages", DATA)?, place.number)
    }

    fn all(&self, channels: &[i64], visit: &mut Visit) -> Result<(), DataError> {
        let connection = self.connection();
        let mut query = self.prepared(&connection, "messages", DATA)?;
        for (topic, Place { number, .. }) in self.messages.iter().filter(|(topic, _)| channels.contains(topic)) {
            let data = self.data(&mut query, *number)?;
            visit(*topic, &data).map_err(|e| self.wrong("messages", format!("row with the id {number}: {e}")))?;
        }
        Ok(())
    }
}

/// An error if a recorder left messages in a file beside this one: they would be missing, or half a change be read.
fn check_closed(path: &Path) -> Result<(), DataError> {
    for ending in ["-wal", "-journal"] {
        let mut beside = path.as_os_str().to_os_string();
        beside.push(ending);
        let beside = PathBuf::from(beside);
        // A file that is done with is empty or begins with zeros.
        let mut first = Vec::new();
        if beside.is_file() {
            fs_err::File::open(&beside)?.take(1).read_to_end(&mut first)?;
        }
        if first.iter().any(|byte| *byte != 0) {
            let message = format!(
                "was not closed by its recorder: {} has changes that are not in it; run `sqlite3 {} 'PRAGMA \
                 journal_mode = DELETE'`, which completes it",
                beside.display(),
                path.display()
            );
            return Err(DataError::file(path, message));
        }
    }
    Ok(())
}

/// The address of a file for SQLite.
fn address(path: &Path) -> std::io::Result<String> {
    let path = absolute(path)?;
    let mut address = String::from(if cfg!(windows) { "file:///" } else { "file://" });
    for byte in path.as_os_str().as_encoded_bytes() {
        match byte {
            b'\\' if cfg!(windows) => address.push('/'),
            b'/' | b':' | b'.' | b'-' | b'_' => address.push(char::from(*byte)),
            byte if byte.is_ascii_alphanumeric() => address.push(char::from(*byte)),
            byte => address.push_str(&format!("%{byte:02X}")),
        }
    }
    Ok(address + "?immutable=1")
}

#[cfg(test)]
mod tests;
