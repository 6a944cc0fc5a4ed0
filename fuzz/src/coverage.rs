//! Which edges of the program were taken. The compiler counts them in bytes (LLVM's SanitizerCoverage,
//! `inline-8bit-counters`) where `make fuzz` asks it to; elsewhere there are none, and files are damaged
//! blindly.

use std::sync::Mutex;

/// Ranges of counters, one an object file: where they begin, and how many.
static COUNTERS: Mutex<Vec<(usize, usize)>> = Mutex::new(Vec::new());

/// What LLVM calls for every object file before `main`.
///
/// # Safety
/// LLVM promises `start..stop` to be counters that live as long as the program.
#[unsafe(no_mangle)]
unsafe extern "C" fn __sanitizer_cov_8bit_counters_init(start: *mut u8, stop: *mut u8) {
    let range = (start as usize, stop as usize - start as usize);
    if let Ok(mut counters) = COUNTERS.lock()
        && !counters.contains(&range)
    {
        counters.push(range);
    }
}

/// Edges seen so far, with how often they were taken, in powers of two.
#[derive(Default)]
pub struct Coverage {
    seen: Vec<u8>,
}

impl Coverage {
    /// Looks at the counters since the last call, and clears them; whether there was something new.
    pub fn grew(&mut self) -> bool {
        let mut grew = false;
        let mut at = 0;
        let Ok(ranges) = COUNTERS.lock() else {
            return false;
        };
        for (start, length) in ranges.iter() {
            // SAFETY: see `__sanitizer_cov_8bit_counters_init`. Threads that count meanwhile lose a count.
            let counters = unsafe { std::slice::from_raw_parts_mut(*start as *mut u8, *length) };
            self.seen.resize(self.seen.len().max(at + length), 0);
            for (counter, seen) in counters.iter_mut().zip(&mut self.seen[at..]) {
                if *counter != 0 {
                    // 1, 2, 3, 4-7, 8-15, ...: one more turn of a long loop is nothing new.
                    let class = 1 << counter.ilog2().min(7);
                    grew |= *seen & class == 0;
                    *seen |= class;
                    *counter = 0;
                }
            }
            at += length;
        }
        grew
    }

    /// Edges that were taken.
    pub fn edges(&self) -> usize {
        self.seen.iter().filter(|s| **s != 0).count()
    }
}
