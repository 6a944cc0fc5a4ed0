//! Damaged files for every reader: none may panic, take more than a gigabyte, or seconds of time.
//!
//! `barchan-fuzz list` names the readers. `barchan-fuzz READER SECONDS [SEED]` tries one: a second process
//! reads damaged files, those that took a new way through the program are kept and damaged further, and
//! what ends that process is kept in `fuzz/crashes`. It exits with 1 when there was any.

mod coverage;
mod mutate;
mod readers;

use std::io::{BufRead, BufReader};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use coverage::Coverage;
use mutate::mutate;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use readers::{READERS, Reader};

/// What a reader may take of memory, bytes, besides what the program itself has.
const MOST_MEMORY: u64 = 1 << 30;
/// Longest that one file may take.
const SLOW: Duration = Duration::from_secs(5);
/// Crashes after which a reader is given up.
const MOST_CRASHES: u32 = 20;

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    match args[..] {
        ["list"] => {
            READERS.iter().for_each(|r| println!("{}", r.name));
            ExitCode::SUCCESS
        }
        ["worker", name, seconds, seed, dir] => match (find(name), seconds.parse(), seed.parse()) {
            (Some(reader), Ok(seconds), Ok(seed)) => work(reader, seconds, seed, Path::new(dir)),
            _ => ExitCode::from(2),
        },
        [name, seconds] | [name, seconds, _] => {
            let seed = args.get(2).and_then(|s| s.parse().ok()).unwrap_or(1);
            match (find(name), seconds.parse()) {
                (Some(reader), Ok(seconds)) => supervise(reader, seconds, seed),
                _ => {
                    eprintln!("error: {name}: see `barchan-fuzz list`; then seconds, a number");
                    ExitCode::from(2)
                }
            }
        }
        _ => {
            eprintln!("usage: barchan-fuzz READER SECONDS [SEED]\n       barchan-fuzz list");
            ExitCode::from(2)
        }
    }
}

fn find(name: &str) -> Option<&'static Reader> {
    READERS.iter().find(|r| r.name == name)
}

/// Runs workers until the time is over, each to its end or its crash.
fn supervise(reader: &Reader, seconds: f64, seed: u64) -> ExitCode {
    let begun = Instant::now();
    let (Ok(dir), Ok(program)) = (tempfile::tempdir(), std::env::current_exe()) else {
        eprintln!("error: no temporary folder, or the program is gone");
        return ExitCode::from(2);
    };
    let mut crashes = 0;
    while begun.elapsed().as_secs_f64() < seconds && crashes < MOST_CRASHES {
        let left = seconds - begun.elapsed().as_secs_f64();
        // Address space is counted: what is asked for, and not only what is touched.
        let worker = Command::new("sh")
            .args(["-c", "ulimit -v $0 && exec \"$@\""])
            .arg((address_space_kib() + MOST_MEMORY / 1024).to_string())
            .arg(&program)
            .args(["worker", reader.name])
            .args([left.to_string(), (seed + u64::from(crashes)).to_string()])
            .arg(dir.path())
            .stderr(Stdio::piped())
            .spawn();
        let mut worker = match worker {
            Ok(worker) => worker,
            Err(e) => {
                eprintln!("error: {}: {e}", program.display());
                return ExitCode::from(2);
            }
        };
        let said = worker.stderr.take().map(BufReader::new);
        let said: Vec<String> = said.map_or(vec![], |s| s.lines().map_while(Result::ok).collect());
        if worker.wait().is_ok_and(|status| status.success()) {
            break;
        }
        crashes += 1;
        let kept = PathBuf::from(format!("fuzz/crashes/{}-{seed}-{crashes}", reader.name));
        let file = dir.path().join(reader.file);
        let copied = std::fs::create_dir_all("fuzz/crashes")
            .and_then(|()| std::fs::copy(&file, &kept).map(drop));
        let first = said.first().map_or("it was killed", String::as_str);
        println!("{}: {}: {first}", reader.name, kept.display());
        if let Err(e) = copied {
            println!("{}: could not be kept: {e}", kept.display());
        }
    }
    ExitCode::from(u8::from(crashes > 0))
}

/// Reads damaged files until the time is over. What ends it is the file it left.
fn work(reader: &Reader, seconds: f64, seed: u64, dir: &Path) -> ExitCode {
    let file = dir.join(reader.file);
    let mut corpus = (reader.seeds)();
    let taken = |bytes: &[u8]| -> bool {
        let written = std::fs::write(&file, bytes);
        written.is_ok() && (reader.read)(&file, bytes)
    };
    let mut coverage = Coverage::default();
    coverage.grew();
    for seed in &corpus {
        // Some are made to be refused.
        taken(seed);
        coverage.grew();
    }
    let progress = Arc::new(AtomicU64::new(0));
    std::thread::spawn({
        let progress = Arc::clone(&progress);
        move || watch(&progress)
    });
    let mut dice = ChaCha8Rng::seed_from_u64(seed);
    let (begun, mut files, mut accepted, mut slowest) =
        (Instant::now(), 0u64, 0u64, Duration::ZERO);
    while begun.elapsed().as_secs_f64() < seconds {
        let [a, b] = [0, 0].map(|_: i32| dice.random_range(0..corpus.len()));
        let damaged = mutate(&corpus[a], &corpus[b], &mut dice);
        let started = Instant::now();
        let Ok(ok) = catch_unwind(AssertUnwindSafe(|| taken(&damaged))) else {
            // The panic has said why.
            return ExitCode::from(1);
        };
        slowest = slowest.max(started.elapsed());
        files += 1;
        progress.store(files, Ordering::Relaxed);
        accepted += u64::from(ok);
        if coverage.grew() {
            corpus.push(damaged);
        }
    }
    println!(
        "{:18} {files:9} files, {accepted:8} accepted, {:6} edges, {:5} kept, slowest {:.0} ms, peak {:.0} MiB",
        reader.name,
        coverage.edges(),
        corpus.len(),
        slowest.as_secs_f64() * 1e3,
        peak_mib()
    );
    ExitCode::SUCCESS
}

/// Ends the process when one file takes too long.
fn watch(progress: &AtomicU64) {
    loop {
        let before = progress.load(Ordering::Relaxed);
        std::thread::sleep(SLOW);
        if progress.load(Ordering::Relaxed) == before {
            eprintln!("it took more than {} s", SLOW.as_secs());
            std::process::exit(1);
        }
    }
}

/// A size in KiB of `/proc/self/status`; 0 where there is none.
fn status_kib(field: &str) -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix(field));
    let number = line.and_then(|l| l.split_whitespace().next()?.parse().ok());
    number.unwrap_or(0)
}

/// Address space that the program has before it reads anything.
fn address_space_kib() -> u64 {
    status_kib("VmSize:")
}

/// The most memory that was ever touched.
fn peak_mib() -> f64 {
    status_kib("VmHWM:") as f64 / 1024.0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Files a reader: `make fuzz` tries millions.
    const FILES: usize = 300;

    #[test]
    fn damaged_files_are_refused_and_never_a_panic() {
        let dir = tempfile::tempdir().unwrap();
        let mut wrong = vec![];
        for reader in READERS {
            let file = dir.path().join(reader.file);
            let read = |bytes: &[u8]| {
                std::fs::write(&file, bytes).unwrap();
                (reader.read)(&file, bytes)
            };
            let seeds = (reader.seeds)();
            if !seeds.iter().any(|s| read(s)) {
                wrong.push(format!("{}: no seed is read", reader.name));
                continue;
            }
            let mut dice = ChaCha8Rng::seed_from_u64(5);
            let mut refused = 0;
            for k in 0..FILES {
                let [a, b] = [k, k / 2].map(|k| &seeds[k % seeds.len()]);
                refused += usize::from(!read(&mutate(a, b, &mut dice)));
                let end = k * a.len() / FILES;
                read(&a[..end]);
                let noise: Vec<u8> = (0..k).map(|_| dice.random()).collect();
                read(&noise);
            }
            if refused == 0 {
                wrong.push(format!("{}: it takes anything", reader.name));
            }
        }
        assert!(wrong.is_empty(), "{wrong:?}");
    }
}
