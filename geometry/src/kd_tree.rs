use nalgebra::Point3;

/// Points in space, to be asked for the nearest (Bentley 1975): a balanced tree whose nodes are the
/// middles of slices of one array. Written here because the crates for it change features that the
/// network library is compiled with.
pub struct KdTree {
    /// Every point and its index; of a slice the middle divides the others along `axis_of` it.
    points: Vec<(Point3<f64>, usize)>,
    /// The dividing axis of the slice whose middle is here.
    axes: Vec<u8>,
}

/// Slices no longer than this are searched from end to end.
const LEAF: usize = 8;

impl KdTree {
    /// A tree of `points`; those that are not finite are never found.
    pub fn new(points: &[Point3<f64>]) -> Self {
        let indexed = points.iter().copied().zip(0..);
        let points: Vec<_> = indexed
            .filter(|(p, _)| p.iter().all(|x| x.is_finite()))
            .collect();
        let mut tree = Self {
            axes: vec![0; points.len()],
            points,
        };
        let mut slices = vec![(0, tree.points.len())];
        while let Some((start, end)) = slices.pop() {
            if end - start <= LEAF {
                continue;
            }
            let slice = &mut tree.points[start..end];
            // Across the longest side.
            let (mut low, mut high) = (slice[0].0, slice[0].0);
            for (p, _) in slice.iter() {
                low = low.inf(p);
                high = high.sup(p);
            }
            let axis = (high - low).imax();
            let middle = (end - start) / 2;
            slice.select_nth_unstable_by(middle, |a, b| a.0[axis].total_cmp(&b.0[axis]));
            tree.axes[start + middle] = axis as u8;
            slices.push((start, start + middle));
            slices.push((start + middle + 1, end));
        }
        tree
    }

    /// Squared distance and index of the `count` points nearest to `p`, nearest first; fewer when the tree
    /// has fewer, none when `p` is not finite.
    pub fn nearest(&self, p: &Point3<f64>, count: usize) -> Vec<(f64, usize)> {
        let mut found: Vec<(f64, usize)> = Vec::with_capacity(count + 1);
        if !p.iter().all(|x| x.is_finite()) {
            return found;
        }
        let farthest = |found: &[(f64, usize)]| match found.len() < count {
            true => f64::INFINITY,
            false => found.last().map_or(0.0, |f| f.0),
        };
        let take = |found: &mut Vec<(f64, usize)>, (q, index): &(Point3<f64>, usize)| {
            let distance = (q - p).norm_squared();
            if distance < farthest(found) {
                let place = found.partition_point(|f| f.0 <= distance);
                found.insert(place, (distance, *index));
                found.truncate(count);
            }
        };
        // Slices still to be searched, and how near they may come.
        let mut slices = vec![(0, self.points.len(), 0.0)];
        while let Some((start, end, least)) = slices.pop() {
            if least >= farthest(&found) {
                continue;
            }
            if end - start <= LEAF {
                self.points[start..end]
                    .iter()
                    .for_each(|q| take(&mut found, q));
                continue;
            }
            let middle = start + (end - start) / 2;
            let axis = usize::from(self.axes[middle]);
            let across = p[axis] - self.points[middle].0[axis];
            take(&mut found, &self.points[middle]);
            let (near, far) = match across < 0.0 {
                true => ((start, middle), (middle + 1, end)),
                false => ((middle + 1, end), (start, middle)),
            };
            slices.push((far.0, far.1, across * across));
            slices.push((near.0, near.1, 0.0));
        }
        found
    }
}

impl KdTree {
    /// The nearest point: the square of its distance, and its index; `None` of no points, or where `p` is not finite.
    /// [`KdTree::nearest`] with a count of 1, without lists.
    pub fn nearest_one(&self, p: &Point3<f64>) -> Option<(f64, usize)> {
        if !p.iter().all(|x| x.is_finite()) {
            return None;
        }
        let mut found: Option<(f64, usize)> = None;
        let farthest = |found: &Option<(f64, usize)>| found.map_or(f64::INFINITY, |f| f.0);
        let take = |found: &mut Option<(f64, usize)>, (q, index): &(Point3<f64>, usize)| {
            let distance = (q - p).norm_squared();
            if distance < farthest(found) {
                *found = Some((distance, *index));
            }
        };
        // Slices still to be searched: each step halves one, so no more wait than an address has bits.
        let mut slices = [(0, 0, 0.0); usize::BITS as usize];
        slices[0] = (0, self.points.len(), 0.0);
        let mut waiting = 1;
        while waiting > 0 {
            waiting -= 1;
            let (mut start, mut end, least) = slices[waiting];
            if least >= farthest(&found) {
                continue;
            }
            // Down to the leaf on the side of `p`; the other sides wait.
            while end - start > LEAF {
                let middle = start + (end - start) / 2;
                let axis = usize::from(self.axes[middle]);
                let across = p[axis] - self.points[middle].0[axis];
                take(&mut found, &self.points[middle]);
                let far = match across < 0.0 {
                    true => (middle + 1, std::mem::replace(&mut end, middle)),
                    false => (std::mem::replace(&mut start, middle + 1), middle),
                };
                slices[waiting] = (far.0, far.1, across * across);
                waiting += 1;
            }
            self.points[start..end]
                .iter()
                .for_each(|q| take(&mut found, q));
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_are_those_of_a_search_from_end_to_end() {
        let share = |i: usize, a: f64| (i as f64 * a).fract();
        // Scattered, with many at equal places.
        let point = |i: usize| match i % 5 {
            0 => Point3::new(0.5, 0.5, 0.5),
            _ => Point3::new(
                share(i, 0.754_877),
                share(i, 0.569_840),
                share(i, 0.381_966),
            ),
        };
        let points: Vec<_> = (0..2000).map(point).collect();
        let tree = KdTree::new(&points);
        for i in 0..300 {
            let p = Point3::new(share(i, 0.3), share(i, 0.7) * 1.5, 0.4);
            let mut all: Vec<f64> = points.iter().map(|q| (q - p).norm_squared()).collect();
            all.sort_unstable_by(f64::total_cmp);
            for count in [1, 7, 30] {
                let found = tree.nearest(&p, count);
                let distances: Vec<f64> = found.iter().map(|f| f.0).collect();
                assert_eq!(distances, all[..count]);
                for (distance, index) in found {
                    assert_eq!((points[index] - p).norm_squared(), distance);
                }
                let one = tree.nearest_one(&p).unwrap();
                assert_eq!(
                    (one.0, (points[one.1] - p).norm_squared()),
                    (all[0], all[0])
                );
            }
        }
        assert!(tree.nearest(&Point3::new(f64::NAN, 0.0, 0.0), 3).is_empty());
        assert_eq!(
            tree.nearest_one(&Point3::new(0.0, f64::INFINITY, 0.0)),
            None
        );
        assert_eq!(KdTree::new(&[]).nearest_one(&points[0]), None);
        assert_eq!(KdTree::new(&points[..2]).nearest(&points[0], 5).len(), 2);
        assert!(KdTree::new(&[]).nearest(&points[0], 5).is_empty());
    }
}
