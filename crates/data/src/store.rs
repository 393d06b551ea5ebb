//! Objects in stores: S3 and stores with the same interface, and files of HTTP servers. Requests that fail are
//! repeated, and a body that breaks off is continued, as long as the object is the one of the beginning (its entity
//! tag).

use crate::limits::MOST_CLOUD_BYTES;
use crate::place::{ErrorKind, Located as _};
use crate::source::Facts;
use crate::{DataError, FilePart};
use object_store::aws::AmazonS3Builder;
use object_store::http::HttpBuilder;
use object_store::path::Path as Key;
use object_store::{
    BackoffConfig, ClientOptions, Error, GetOptions, GetRange, ObjectMeta, ObjectStore, ObjectStoreExt as _,
    RetryConfig,
};
use rayon::prelude::*;
use std::collections::HashMap;
use std::future::Future;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::{Arc, LazyLock, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::runtime::{Builder, Runtime};

/// Bytes that are asked for at once, at most.
const AT_ONCE: u64 = 8 << 20;

/// How often a request is repeated.
const RETRIES: usize = 5;

/// Variables that say how to authenticate.
const CREDENTIALS: [&str; 6] = [
    "AWS_ACCESS_KEY_ID",
    "AWS_WEB_IDENTITY_TOKEN_FILE",
    "AWS_CONTAINER_CREDENTIALS_RELATIVE_URI",
    "AWS_CONTAINER_CREDENTIALS_FULL_URI",
    "AWS_METADATA_ENDPOINT",
    "AWS_SKIP_SIGNATURE",
];

/// The stores that are open: buckets and servers.
static STORES: LazyLock<Mutex<HashMap<String, Arc<dyn ObjectStore>>>> = LazyLock::new(Mutex::default);

/// What the last listings said.
static LISTED: LazyLock<Mutex<HashMap<PathBuf, Facts>>> = LazyLock::new(Mutex::default);

/// Threads that talk to stores.
static RUNTIME: LazyLock<std::io::Result<Runtime>> =
    LazyLock::new(|| Builder::new_multi_thread().worker_threads(2).enable_all().build());

/// Size and state of an object.
pub(crate) fn facts(url: &Path) -> Result<Facts, DataError> {
    if let Some(known) = lock(&LISTED).get(url) {
        return Ok(known.clone());
    }
    let (store, key) = place(url)?;
    Ok(of_meta(&wait(url, async move { store.head(&key).await })?))
}

/// As [`crate::source::list`].
pub(crate) fn list(folder: &Path, ending: &str, index: &str) -> Result<Vec<(PathBuf, Facts)>, DataError> {
    let found: Vec<(PathBuf, Facts)> = if is_s3(folder) {
        let metas = listing(folder)?.into_iter().filter_map(|meta| {
            let name = meta.location.filename()?.to_string();
            let wanted = name.rsplit_once('.').is_some_and(|(_, end)| end == ending) && !name.starts_with('.');
            wanted.then(|| (folder.join(name), of_meta(&meta)))
        });
        metas.collect()
    } else {
        let path = folder.join(index);
        let bytes = FilePart::from(&*path).read(MOST_CLOUD_BYTES)?;
        let name_of = |line: &[u8]| {
            let line: serde_json::Value = serde_json::from_slice(line).ok()?;
            let name = line.get("shard")?.as_str()?;
            crate::limits::check_name(name).is_ok().then(|| folder.join(name))
        };
        let paths: Vec<PathBuf> = bytes.split(|byte| *byte == b'\n').filter_map(name_of).collect();
        lock(&LISTED).retain(|known, _| known.parent() != Some(folder));
        paths.into_par_iter().map(|path| Ok((path.clone(), facts(&path)?))).collect::<Result<_, DataError>>()?
    };
    let mut listed = lock(&LISTED);
    listed.retain(|known, _| known.parent() != Some(folder));
    listed.extend(found.iter().cloned());
    Ok(found)
}

/// Whether there is an object with this name; an error if the store does not say.
pub(crate) fn is_object(url: &Path) -> Result<bool, DataError> {
    match facts(url) {
        Ok(_) => Ok(true),
        Err(error) if error.place().kind == ErrorKind::Missing => Ok(false),
        Err(error) => Err(error),
    }
}

/// Whether there are objects below a prefix; of an `http` server, whether there is an index of shards.
pub(crate) fn is_prefix(url: &Path) -> Result<bool, DataError> {
    if is_s3(url) {
        let (store, prefix) = place(url)?;
        let found = wait(url, async move { store.list_with_delimiter(Some(&prefix)).await })?;
        return Ok(!found.objects.is_empty() || !found.common_prefixes.is_empty());
    }
    Ok(is_object(&url.join("index.jsonl"))? || is_object(&url.join("dataset.toml"))?)
}

/// The objects directly below a prefix.
fn listing(url: &Path) -> Result<Vec<ObjectMeta>, DataError> {
    let (store, prefix) = place(url)?;
    Ok(wait(url, async move { store.list_with_delimiter(Some(&prefix)).await })?.objects)
}

/// Reads an object in ranges.
pub(crate) struct ObjectReader {
    url: PathBuf,
    facts: Facts,
    /// What is asked for ends here as long as nothing beyond is wanted.
    end: u64,
    at: u64,
    buffer: Vec<u8>,
    buffer_at: u64,
}

impl ObjectReader {
    pub(crate) fn open(url: &Path, end: Option<u64>) -> Result<Self, DataError> {
        let facts = facts(url)?;
        let end = end.unwrap_or(facts.bytes).min(facts.bytes);
        Ok(ObjectReader { url: url.into(), facts, end, at: 0, buffer: Vec::new(), buffer_at: 0 })
    }

    fn fetch(&mut self) -> Result<(), DataError> {
        let until = if self.at < self.end { self.end } else { self.facts.bytes };
        let range = self.at..until.min(self.at + AT_ONCE);
        let wanted = range.end - range.start;
        let options = GetOptions {
            if_match: self.facts.tag.clone(),
            range: Some(GetRange::Bounded(range)),
            ..GetOptions::default()
        };
        let (store, key) = place(&self.url)?;
        let bytes = wait(&self.url, async move { store.get_opts(&key, options).await?.bytes().await })?;
        if bytes.len() as u64 != wanted {
            let message = format!("the store sent {} of {wanted} bytes from byte {} on", bytes.len(), self.at);
            return Err(DataError::file(&self.url, message));
        }
        (self.buffer, self.buffer_at) = (bytes.into(), self.at);
        Ok(())
    }
}

impl Read for ObjectReader {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        if out.is_empty() || self.at >= self.facts.bytes {
            return Ok(0);
        }
        let inside = self.buffer_at..self.buffer_at + self.buffer.len() as u64;
        if !inside.contains(&self.at) {
            self.fetch().map_err(std::io::Error::other)?;
        }
        let rest = &self.buffer[(self.at - self.buffer_at) as usize..];
        let count = rest.len().min(out.len());
        out[..count].copy_from_slice(&rest[..count]);
        self.at += count as u64;
        Ok(count)
    }
}

impl Seek for ObjectReader {
    fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
        let at = match to {
            SeekFrom::Start(at) => Some(at),
            SeekFrom::Current(by) => self.at.checked_add_signed(by),
            SeekFrom::End(by) => self.facts.bytes.checked_add_signed(by),
        };
        self.at = at.ok_or_else(|| std::io::Error::from(std::io::ErrorKind::InvalidInput))?;
        Ok(self.at)
    }
}

fn is_s3(url: &Path) -> bool {
    url.as_os_str().as_encoded_bytes().starts_with(b"s3://")
}

/// The store of an object, and its name there.
fn place(url: &Path) -> Result<(Arc<dyn ObjectStore>, Key), DataError> {
    let wrong = |message: &str| DataError::file(url, message);
    let text = url.to_str().ok_or_else(|| wrong("its name is not UTF-8"))?;
    let (scheme, rest) = text.split_once("://").ok_or_else(|| wrong("is no address of an object"))?;
    let (host, path) = rest.split_once('/').unwrap_or((rest, ""));
    if host.is_empty() {
        return Err(wrong("names no bucket or server: the form is s3://BUCKET/PREFIX or https://SERVER/PATH"));
    }
    let mut names: Vec<&str> = Vec::new();
    for name in path.split('/').filter(|name| !name.is_empty() && *name != ".") {
        if name == ".." {
            names.pop();
        } else {
            names.push(name);
        }
    }
    let key = Key::parse(names.join("/")).map_err(|e| wrong(&format!("is no name of an object: {e}")))?;
    let base = format!("{scheme}://{host}");
    if let Some(store) = lock(&STORES).get(&base) {
        return Ok((store.clone(), key));
    }
    let store = connect(url, scheme, host)?;
    Ok((lock(&STORES).entry(base).or_insert(store).clone(), key))
}

fn connect(url: &Path, scheme: &str, host: &str) -> Result<Arc<dyn ObjectStore>, DataError> {
    let wrong = |error: &dyn std::fmt::Display| DataError::file(url, format!("cannot be read: {error}"));
    let backoff =
        BackoffConfig { init_backoff: Duration::from_millis(100), max_backoff: Duration::from_secs(5), base: 2.0 };
    let retry = RetryConfig { backoff, max_retries: RETRIES, retry_timeout: Duration::from_secs(120) };
    let client = ClientOptions::new().with_timeout(Duration::from_secs(60));
    if scheme != "s3" {
        let client = client.with_allow_http(scheme == "http");
        let store = HttpBuilder::new().with_url(format!("{scheme}://{host}")).with_client_options(client);
        return Ok(Arc::new(store.with_retry(retry).build().map_err(|e| wrong(&e))?));
    }
    if !CREDENTIALS.iter().any(|name| std::env::var_os(name).is_some()) {
        let message = "needs credentials: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, AWS_SKIP_SIGNATURE=true for a \
                       public bucket, or AWS_METADATA_ENDPOINT=http://169.254.169.254 for the role of a machine of AWS";
        return Err(DataError::file(url, message));
    }
    let endpoint = ["AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT"].map(|name| std::env::var(name).ok());
    let is_plain = endpoint.into_iter().flatten().any(|endpoint| endpoint.starts_with("http://"));
    let store = AmazonS3Builder::from_env().with_bucket_name(host).with_retry(retry);
    // Set here, the options replace those of the environment.
    let store = if is_plain { store.with_allow_http(true) } else { store };
    Ok(Arc::new(store.build().map_err(|e| wrong(&e))?))
}

fn of_meta(meta: &ObjectMeta) -> Facts {
    Facts { bytes: meta.size, changed: Some(meta.last_modified.into()), tag: meta.e_tag.clone() }
}

/// Waits for an answer of a store.
fn wait<T: Send + 'static>(
    url: &Path,
    answer: impl Future<Output = Result<T, Error>> + Send + 'static,
) -> Result<T, DataError> {
    let runtime = RUNTIME.as_ref().map_err(|e| DataError::file(url, format!("no threads for the network: {e}")))?;
    // The answer is made by a thread of the runtime; this thread may be one of any other pool.
    let (send, receive) = std::sync::mpsc::sync_channel(1);
    runtime.spawn(async move {
        let _ = send.send(answer.await);
    });
    let answer = receive.recv().map_err(|_| DataError::file(url, "the request was given up"))?;
    answer.map_err(|error| explained(url, &error))
}

/// What went wrong, and what to do.
fn explained(url: &Path, error: &Error) -> DataError {
    let mut causes = vec![error.to_string()];
    let mut cause: Option<&dyn std::error::Error> = std::error::Error::source(error);
    while let Some(next) = cause {
        let text = next.to_string();
        if causes.last().is_none_or(|last| !last.contains(&text)) {
            causes.push(text);
        }
        cause = next.source();
    }
    let causes = causes.join(": ").replace('\n', " ");
    // A listing of a bucket that does not exist is a generic error.
    if causes.contains("NoSuchBucket") {
        let message = "the bucket does not exist: check its name, AWS_REGION and AWS_ENDPOINT_URL";
        return DataError::file(url, message);
    }
    match error {
        Error::NotFound { .. } => DataError::missing(url, "does not exist in the store"),
        Error::Precondition { .. } => {
            DataError::file(url, "was changed in the store since the data set was opened: start the program again")
        }
        Error::Unauthenticated { .. } | Error::PermissionDenied { .. } => {
            let message = format!(
                "the store refuses access: check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and the rights of the bucket ({causes})"
            );
            DataError::file(url, message)
        }
        _ => {
            let message = format!(
                "cannot be read, also when repeated: check the network and AWS_ENDPOINT_URL, and start the program again \
                 ({causes})"
            );
            DataError::file(url, message)
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
