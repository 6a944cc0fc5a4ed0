use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::JoinHandle;

use crate::{DataError, StereoFrame, StereoSource};

/// Reads frames on background threads and yields them in the order asked for.
///
/// `order` may repeat and skip frames. At most about `ahead` frames (at least one) wait in memory.
/// A frame that cannot be read is an `Err` in its place and the iterator goes on. Dropping it
/// stops the threads, each after the frame in hand.
pub fn prefetch(source: Arc<dyn StereoSource>, order: Vec<usize>, ahead: usize) -> Prefetch {
    prefetch_with(order, ahead, move |index| source.frame(index))
}

/// As [`prefetch`], with whatever `read` makes of an index: a frame and its truth, say.
pub fn prefetch_with<T: Send + 'static>(
    order: Vec<usize>,
    ahead: usize,
    read: impl Fn(usize) -> Result<T, DataError> + Send + Sync + 'static,
) -> Prefetch<T> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let threads = cores.min(4).min(ahead).max(1);
    // A thread holds one finished frame in hand besides those in its channel.
    let queued = (ahead / threads).saturating_sub(1);
    let (order, read): (Arc<[usize]>, _) = (order.into(), Arc::new(read));
    // Thread k reads every threads-th frame from the k-th into a channel of its own, so that
    // taking from the channels in turn restores the order.
    let (channels, workers) = (0..threads)
        .map(|k| {
            let (send, receive) = sync_channel(queued);
            let (read, order) = (Arc::clone(&read), Arc::clone(&order));
            let worker = std::thread::spawn(move || {
                for index in order.iter().skip(k).step_by(threads) {
                    // The receiver is gone: nobody wants more.
                    if send.send(read(*index)).is_err() {
                        return;
                    }
                }
            });
            (receive, worker)
        })
        .unzip();
    Prefetch {
        channels,
        workers,
        order,
        next: 0,
    }
}

/// What [`prefetch`] and [`prefetch_with`] return.
pub struct Prefetch<T = StereoFrame> {
    channels: Vec<Receiver<Result<T, DataError>>>,
    workers: Vec<JoinHandle<()>>,
    order: Arc<[usize]>,
    next: usize,
}

impl<T> Iterator for Prefetch<T> {
    type Item = Result<T, DataError>;

    fn next(&mut self) -> Option<Self::Item> {
        let index = *self.order.get(self.next)?;
        let channel = &self.channels[self.next % self.channels.len()];
        self.next += 1;
        Some(channel.recv().unwrap_or_else(|_| {
            Err(DataError::Layout {
                spec: format!("frame {index}"),
                message: "the thread that reads it has stopped; please report this".into(),
            })
        }))
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        let left = self.order.len() - self.next.min(self.order.len());
        (left, Some(left))
    }
}

impl<T> ExactSizeIterator for Prefetch<T> {}

impl<T> Drop for Prefetch<T> {
    fn drop(&mut self) {
        self.channels.clear();
        for worker in self.workers.drain(..) {
            // A panic was told by next() already.
            let _ = worker.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use barchan_geometry::RectifiedRig;

    struct Counting {
        rig: RectifiedRig,
        read: AtomicUsize,
    }

    impl StereoSource for Counting {
        fn rig(&self) -> &RectifiedRig {
            &self.rig
        }
        fn len(&self) -> usize {
            100
        }
        fn frame(&self, index: usize) -> Result<StereoFrame, DataError> {
            self.read.fetch_add(1, Ordering::SeqCst);
            assert!(index != 66, "frame 66 panics");
            if index == 13 {
                return Err(DataError::Layout {
                    spec: "13".into(),
                    message: "unlucky".into(),
                });
            }
            let image = crate::Rgb::new(1, 1);
            Ok(StereoFrame {
                index,
                name: String::new(),
                time: 0.0,
                left: image.clone(),
                right: image,
            })
        }
    }

    fn source() -> Arc<Counting> {
        let rig = RectifiedRig {
            width: 1,
            height: 1,
            fx: 1.0,
            fy: 1.0,
            cx: 0.0,
            cy: 0.0,
            doffs: 0.0,
            baseline: 1.0,
        };
        Arc::new(Counting {
            rig,
            read: AtomicUsize::new(0),
        })
    }

    #[test]
    fn frames_come_in_the_order_asked_for_and_errors_in_their_place() {
        let order: Vec<usize> = (0..60).map(|i| (i * 37) % 61).collect();
        for ahead in [0, 1, 2, 3, 7, 100] {
            let got = prefetch(source(), order.clone(), ahead);
            assert_eq!(got.len(), order.len());
            let got: Vec<usize> = got.map(|f| f.map_or(13, |f| f.index)).collect();
            assert_eq!(got, order, "ahead {ahead}");
        }
    }

    #[test]
    fn reading_ahead_is_bounded_and_stops_on_drop() {
        let counting = source();
        let mut frames = prefetch(counting.clone(), (0..60).collect(), 4);
        for _ in 0..5 {
            frames.next();
        }
        drop(frames);
        // 5 taken, at most 4 ahead, and one in hand on each of up to 4 threads.
        let read = counting.read.load(Ordering::SeqCst);
        assert!((5..=13).contains(&read), "{read}");
        assert_eq!(Arc::strong_count(&counting), 1);
    }

    #[test]
    fn a_panic_in_a_reader_is_an_error_and_not_a_hang() {
        let frames: Vec<_> = prefetch(source(), vec![65, 66, 67, 68], 1).collect();
        assert!(frames[0].is_ok());
        assert!(
            frames[1]
                .as_ref()
                .unwrap_err()
                .to_string()
                .contains("frame 66")
        );
    }
}
