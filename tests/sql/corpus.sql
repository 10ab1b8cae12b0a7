-- SQL queries over the published results (results/reference), with the expected result of each:
--
--     -- agree: a description
--     the query                       has the same rows as in DuckDB, in any order if there is no ORDER BY
--
--     -- refuse: a description | a part of the message
--     the query                       is refused with this message
--
-- A query ends where the next entry begins. tests/sql.rs runs the queries, and tests/python/compare_sql.py compares the
-- answers.

-- agree: all columns and rows of a table
select * from epochs

-- agree: a table of bytes
select run, modality, sample, reference from frames where motion > 0.01

-- agree: the runs' records
select experiment, run, status, latent, seed, parameters, git_dirty, reason, prediction_seconds from runs

-- agree: filters, all of them
select run, index, value from metrics where task = 'prediction' and model = 'network' and metric = 'r2' and index >= 10

-- agree: or binds less than and
select count(*) from metrics where metric = 'r2' or metric = 'mae' and index = 3

-- agree: brackets
select count(*) from metrics where (metric = 'r2' or metric = 'mae') and index = 3

-- agree: not
select count(*) from metrics where not (metric = 'r2' or index > 3)

-- agree: a null is not unequal
select count(*) from metrics where direction <> 'fe'

-- agree: nor equal
select count(*) from metrics where direction = null

-- agree: is null
select count(*) from metrics where direction is null and index is not null

-- agree: not of unknown is unknown
select count(*) from metrics where not (index = 1)

-- agree: unknown or true
select count(*) from metrics where index = 1 or metric = 'r2'

-- agree: three values of and, or, not
select true and null as a, false and null as b, true or null as c, false or null as d, not null as e

-- agree: is distinct from
select count(*) from metrics where direction is distinct from 'fe'

-- agree: is not distinct from null
select count(*) from metrics where index is not distinct from null

-- agree: nulls are not distinct
select null is not distinct from null as a, null is distinct from null as b, (null is distinct from 1) and true as c, 3 is distinct from 1 + 2 as d

-- agree: what binds more than what
select not 1 = 2 as a, 1 + 1 in (2, 3) as b, not 1 in (2) as c, 2 * 3 between 5 and 7 or false as d, -2 + 3 as e, 'a' || 'b' like 'ab' as f, 1 = 1 is true as g, not null is null as h, 3 - 2 - 1 as i, 8 / 4 / 2 as j, 7 % 4 * 2 as k, not true or true as l, not false and false as m

-- agree: is true, is false, is unknown
select count(*) as n, (index > 3) is true as a, (index > 3) is not false as b, (index > 3) is null as c from metrics group by 2, 3, 4

-- agree: a where that is null
select count(*) from metrics where null

-- agree: between
select count(*) from metrics where value between 0 and 1

-- agree: not between, with nulls
select count(*) from metrics where index not between 3 and 7

-- agree: between with bounds the wrong way round
select count(*) from metrics where index between 7 and 3

-- agree: in
select count(*) from metrics where metric in ('r2', 'mae', 'nothing')

-- agree: in with null
select count(*) from metrics where index in (1, 2, null)

-- agree: not in
select count(*) from metrics where index not in (1, 2)

-- agree: not in with null finds nothing
select count(*) from metrics where index not in (1, 2, null)

-- agree: in with expressions
select count(*) from metrics where index in (seed, seed + 3)

-- agree: in with integers and real numbers
select count(*) from metrics where latent in (16, 64.0, 3.5)

-- agree: in as a value
select distinct index, index in (1, 2) as a, index in (1, null) as b, index not in (1, null) as c from metrics where index < 3 or index is null

-- agree: like
select distinct metric from metrics where metric like 'relative\_error' or metric like '%mape'

-- agree: like with one letter
select distinct metric from metrics where metric like '_mae' or metric like 'r_'

-- agree: not like
select distinct metric from metrics where metric not like '%error%'

-- agree: ilike
select count(*) from metrics where metric ilike 'R%' and not task like 'RECON%'

-- agree: signs in a pattern
select 'a.b' like 'a.b' as a, 'axb' like 'a.b' as b, 'a+b(c)[d]^$|?*' like 'a+b(c)[d]^$|?*' as c, 'a<b>c' like '%<b>%' as d

-- agree: a pattern is of the whole text
select 'metric' like 'etri' as a, 'metric' like '%etri%' as b, '' like '%' as c, '' like '_' as d, null like '%' as e

-- agree: text compares by its letters' numbers
select count(*) from metrics where metric < 'rmse' and metric >= 'mae'

-- agree: upper case comes before lower case
select 'B' < 'a' as a, 'Zebra' < 'apple' as b, 'ä' > 'z' as c, 'a' < 'aa' as d

-- agree: arithmetic of integers
select 7 + 2 as a, 7 - 9 as b, 7 * -2 as c, -7 as d, 7 - -2 as e, 2 + 3 * 4 as f, (2 + 3) * 4 as g

-- agree: division of integers gives a real number
select 7 / 2 as a, -7 / 2 as b, 6 / 3 as c, 1 / 3 * 3 as d

-- agree: the remainder has the sign of what is divided
select 7 % 3 as a, -7 % 3 as b, 7 % -3 as c, mod(7, 3) as d, mod(-7.5::double, 2) as e

-- agree: remainders of a column
select distinct index, index % 2 as a, mod(index, 3) as b, (index - 10) % 3 as c from metrics where index is not null

-- agree: division by zero of real numbers
select 1.0::double / 0 as a, -1.0::double / 0 as b, 1 / 0 as c

-- agree: 0 / 0 is no number
select 0 / 0 as a, (0 / 0) > 1e300 as b, (0 / 0) = (0 / 0) as c

-- agree: columns below zero
select distinct latent - 100 as a, -latent as b, 5 - latent as c from metrics

-- agree: real and integer mix
select latent * 0.5 as a, latent / 7 as b, latent + value as c from metrics where metric = 'r2' and index = 0

-- agree: arithmetic with null
select null + 1 as a, index + 1 as b, value * null as c from metrics where index is null and metric = 'r2' and seed = 0

-- agree: numbers with an exponent
select 1e3 as a, 1.5e-3 as b, 2.5E+2 as c, count(*) as d from metrics where value > 1e2

-- agree: large integers
select 9223372036854775806 + 1 as a, 9007199254740993 as b, 3037000499 * 3037000499 as c

-- agree: integers compare with real numbers
select 1 = 1.0 as a, 2 > 1.5 as b, 3 <> 3.0 as c

-- agree: abs, sign
select abs(-3) as a, abs(-2.5) as b, sign(-7) as c, sign(0) as d, sign(2.5) as e, abs(null) as f

-- agree: halves round away from zero
select round(0.5::double) as a, round(1.5::double) as b, round(2.5::double) as c, round(-2.5::double) as d, round(7) as e

-- agree: round to decimals
select round(value, 2) as a, round(value, 0) as b, round(value) as c from metrics where metric = 'smape'

-- agree: floor, ceil, trunc
select floor(value) as a, ceil(value) as b, ceiling(-value) as c, trunc(-value) as d from metrics where metric = 'smape' and index = 1

-- agree: floor of pairs
select distinct index, floor(index / 2) as pair from metrics

-- agree: roots and powers
select sqrt(2) as a, cbrt(27) as b, power(2, 10) as c, pow(2, 0.5) as d, sqrt(latent) as e, exp(1) as f from runs

-- agree: logarithms
select ln(10) as a, log10(1000) as b, log2(8) as c, log(100) as d, floor(log10(1000)) as e

-- agree: logarithms of columns
select run, ln(parameters) as a, log10(parameters) as b, log2(latent) as c from runs

-- agree: what is no real number
select isnan(sqrt(-1.0::double)) as a, isinf(-ln(0.0::double)) as b, isfinite(1 / 3) as c, sqrt(null) as d

-- agree: angles
select sin(1) as a, cos(1) as b, tan(1) as c, asin(0.5) as d, acos(0.5) as e, atan(2) as f, atan2(1, -1) as g, degrees(pi()) as h, radians(90) as i

-- agree: greatest and least leave nulls out
select greatest(1, null, 3) as a, least(2, null, 1) as b, greatest(1.5, 2) as c, least(null, null) as d, greatest(latent, 50) as e, least(value, 0.5) as f from metrics where index = 2 and metric = 'r2'

-- agree: NaN is greater than numbers
select greatest(1.0::double, 0 / 0) as a, least(1.0::double, 0 / 0) as b

-- agree: coalesce, ifnull, nullif
select distinct coalesce(direction, 'both') as a, ifnull(index, -1) as b, nullif(index, 3) as c, coalesce(null, index, 7) as d from metrics

-- agree: nullif with a null
select nullif(1, null) as a, nullif(null, 1) as b, nullif('a', 'a') as c

-- agree: nullif against division by zero
select run, sum(value) / nullif(count(value), 0) as mean from metrics where metric = 'r2' group by run

-- agree: upper, lower, length
select distinct upper(metric) as a, lower('ÄBC') as b, length(metric) as c, length('äöü') as d, char_length('') as e from metrics

-- agree: substr
select distinct substr(run, 1, 5) as a, substr(run, 3) as b, substring(metric, 2, 1) as c, substring('hello' from 2 for 3) as d, substr('hello', 9) as e from metrics

-- agree: left, right
select left('hello', 2) as a, right('hello', 2) as b, left('äöü', 1) as c, right('hello', 0) as d, left('hi', 9) as e

-- agree: trim
select trim('  a b ') as a, ltrim('  a ') as b, rtrim(' a  ') as c, trim('xxaxx', 'x') as d, trim(both 'x' from 'xax') as e, trim(leading 'x' from 'xax') as f

-- agree: replace
select distinct replace(metric, 'error', 'e') as a, replace('a.b.c', '.', '') as b, replace('aaa', 'aa', 'b') as c from metrics

-- agree: joined text
select distinct scenario || '-' || latent as a, 'x' || null as b, concat(scenario, null, latent, true) as c from metrics

-- agree: starts_with, ends_with, contains
select distinct starts_with(metric, 'r') as a, ends_with(metric, 'e') as b, contains(metric, 'map') as c, metric from metrics

-- agree: parts of a text
select distinct split_part(run, '-', 1) as a, split_part(run, '-', 2) as b, split_part(input, '+', 5) as c from runs

-- agree: quotes within text
select 'it''s' as a, '' as b, '%_' as c, 'a
b' as d

-- agree: cast text to numbers
select cast('12' as integer) as a, cast(' 7 ' as bigint) as b, '1.5'::double as c, cast('1e3' as double precision) as d

-- agree: cast parts of names to numbers
select distinct cast(replace(split_part(run, '-', 2), 'z', '') as integer) as latent from runs

-- agree: cast numbers
select cast(3 as double) as a, cast(true as integer) as b, cast(latent as double) / 3 as c, cast(0 as boolean) as d from runs

-- agree: cast rounded numbers
select cast(round(value) as integer) as a, cast(floor(value) as bigint) as b, cast(trunc(-value) as integer) as c from metrics where metric = 'smape' and index < 3

-- agree: cast to text
select cast(12 as varchar) as a, cast(latent as text) as b, cast(true as varchar) as c, (-5)::varchar as d from runs

-- agree: try_cast
select try_cast('abc' as integer) as a, try_cast('1.5' as double) as b, try_cast(metric as double) as c from metrics where index = 0

-- agree: cast of null
select cast(null as integer) as a, cast(null as varchar) as b, null::double as c

-- agree: case
select distinct case when index is null then 'all' when index < 10 then 'base' else 'tip' end as part from metrics

-- agree: case without else
select count(case when metric = 'r2' then 1 end) as a, sum(case when index = 1 then value end) as b from metrics where metric in ('r2', 'mae')

-- agree: case of a value
select distinct case metric when 'r2' then 1 when 'mae' then 2.5 end as a from metrics

-- agree: a null condition is not true
select case when null then 1 else 2 end as a, case null when null then 1 else 2 end as b

-- agree: case in case
select distinct case when latent > 16 then case when seed = 0 then 'a' else 'b' end else 'c' end as a from runs

-- agree: aggregates without groups
select count(*) as a, count(value) as b, sum(value) as c, avg(value) as d, min(value) as e, max(value) as f from metrics

-- agree: aggregates without names
select count(*), count(value), avg(value), max(value) from metrics

-- agree: two aggregates of one column
select metric, avg(value), max(value), avg(value) from metrics group by metric order by metric

-- agree: aggregates of nothing
select count(*) as a, count(value) as b, sum(value) as c, avg(value) as d, min(metric) as e, max(value) as f, stddev(value) as g, median(value) as h from metrics where false

-- agree: aggregates of nulls alone
select sum(value) as a, avg(value) as b, min(value) as c, count(value) as d, count(*) as e, median(value) as f from metrics where value is null

-- agree: groups of nothing are none
select metric, count(*) from metrics where value > 1e300 group by metric

-- agree: sums of integers are integers
select sum(latent) as a, sum(seed) as b, avg(seed) as c, sum(parameters) as d from runs

-- agree: aggregates of text
select min(metric) as a, max(metric) as b, count(distinct metric) as c, count(direction) as d from metrics

-- agree: aggregates of conditions
select bool_and(value > -1e30) as a, bool_or(value > 100) as b, bool_and(latent > 2) as c, bool_or(index > 100) as d, min(index > 3) as e from metrics

-- agree: spread
select stddev(value) as a, stddev_samp(value) as b, stddev_pop(value) as c, variance(value) as d, var_samp(value) as e, var_pop(value) as f from metrics where metric = 'smape'

-- agree: spread of one
select stddev(seed) as a, variance(seed) as b, stddev_pop(seed) as c, median(seed) as d from (select seed from runs order by run limit 1)

-- agree: median and quantiles
select metric, median(value) as a, quantile_cont(value, 0.25) as b, quantile_cont(value, 0.9) as c, quantile_cont(index, 0) as d from metrics group by metric

-- agree: mean
select mean(value) as a from metrics where metric = 'r2'

-- agree: max is NaN where there is one
select max(x) as a, min(x) as b, count(x) as c from (select 0 / 0 as x union all select 1.5)

-- agree: distinct aggregates
select count(distinct latent) as a, sum(distinct latent) as b, avg(distinct latent) as c, count(distinct direction) as d, max(distinct latent) as e from metrics

-- agree: filter
select metric, count(*) filter (where index is null) as a, avg(value) filter (where index = 0) as b, sum(value) filter (where false) as c from metrics group by metric

-- agree: filter of all rows
select count(*) filter (where value > 1) as a, count(value) filter (where index = 3) as b from metrics

-- agree: aggregates of expressions
select sum(value * 2 + 1) as a, max(100.0 * latent / 3) as b, avg(abs(value)) as c, count(index + 1) as d, sum(1) as e from metrics where metric = 'mae'

-- agree: expressions of aggregates
select max(value) - min(value) as a, sum(value) / count(value) as b, round(avg(value), 3) as c, -max(index) as d, coalesce(min(index), 0) as e from metrics where metric = 'mae'

-- agree: group by
select scenario, latent, avg(value) as wmape from metrics where task = 'prediction' and model = 'network' and modality = 'contact_force' and metric = 'wmape' and index is null and direction is null group by scenario, latent order by scenario, latent

-- agree: nulls are one group
select direction, index, count(*) as n from metrics group by direction, index

-- agree: group by what is not selected
select count(*) as n from metrics group by metric, direction

-- agree: group by an expression
select latent + 1 as a, count(*) as n from metrics group by latent + 1

-- agree: group by an expression, used within another
select (latent + 1) * 2 as a, floor(index / 2) + 1 as b, count(*) as n from metrics group by latent + 1, floor(index / 2)

-- agree: group by a name of select
select case when index is null then 'all' else 'one' end as part, count(*) as n from metrics group by part

-- agree: group by numbers
select metric, model, count(*) as n from metrics group by 1, 2

-- agree: group by a constant
select 'x' as a, count(*) as n from runs group by 'x'

-- agree: group by all
select metric, latent > 16 as large, count(*) as n, max(value) as m from metrics group by all

-- agree: a key in an expression with an aggregate
select metric, latent, sum(value) + latent as a from metrics group by metric, latent

-- agree: keys by a table's name
select m.metric, avg(m.value) as a from metrics m group by m.metric order by metric

-- agree: upper and lower case are the same in names
SELECT Metric, AVG(VALUE) AS Mean FROM Metrics GROUP BY METRIC ORDER BY mean

-- agree: having
select metric, count(*) as n from metrics group by metric having count(*) > 10000

-- agree: having with another aggregate
select run, avg(value) as a from metrics where metric = 'r2' group by run having min(value) < -1 and count(value) > 5

-- agree: having with a name of select
select metric, avg(value) as mean from metrics group by metric having mean > 1

-- agree: having before select's name of the same column
select metric, min(value) as value from metrics group by metric having count(value) > 5000

-- agree: having without group by
select count(*) as n from metrics having count(*) > 5

-- agree: having that is false
select max(value) as n from metrics having count(*) < 5

-- agree: having and order by an aggregate
select metric, avg(value) from metrics group by metric having avg(value) > 0 order by avg(value)

-- agree: order by what is not selected
select run from runs order by prediction_seconds

-- agree: order by an aggregate that is not selected
select metric from metrics group by metric order by count(*) desc, metric

-- agree: nulls come last
select distinct index from metrics order by index

-- agree: descending as well
select distinct index from metrics order by index desc

-- agree: nulls first
select distinct index, direction from metrics order by direction nulls first, index desc nulls first

-- agree: several keys
select run, metric, value from metrics where index = 1 and model = 'network' and task = 'prediction' and modality = 'proprioception' order by metric desc, value, run

-- agree: order by numbers
select seed, latent, run from runs order by 2 desc, 1, 3

-- agree: order by a name of select
select -latent as latent, run from runs order by latent, run

-- agree: order by an expression of columns
select -latent as latent, run from runs order by latent + 0, run

-- agree: order by an expression of a name of select
select run, latent * 2 as twice from runs order by -twice, run

-- agree: order by all
select latent, seed, run from runs order by all

-- agree: order by a condition
select metric, index from (select distinct metric, index from metrics) order by index is null, metric = 'r2' desc, metric, index

-- agree: NaN comes after numbers
select x from (select 0 / 0 as x union all select 1.5 union all select null union all select -2) order by x

-- agree: limit
select run, epoch, value from epochs order by value, run, epoch, experiment, task, split, term limit 7

-- agree: limit and offset
select distinct metric from metrics order by metric limit 3 offset 2

-- agree: offset alone
select distinct metric from metrics order by metric offset 6

-- agree: limit 0
select * from metrics limit 0

-- agree: limit beyond the end
select distinct metric from metrics order by metric limit 100 offset 5

-- agree: the largest values
select value from metrics where metric = 'smape' order by value desc limit 5

-- agree: distinct
select distinct direction, index from metrics

-- agree: distinct of expressions
select distinct latent > 16, seed % 2 from runs

-- agree: distinct with order by
select distinct latent as l from metrics order by l desc

-- agree: distinct of groups
select distinct count(*) as n from metrics group by metric, run

-- agree: a constant for each row
select 1 as one, 'x' as x from runs

-- agree: no table
select 1 as a, 'text' as b, true as c, null as d

-- agree: where without a table
select 1 as a where 1 > 2

-- agree: subquery in from
select metric, avg(best) as a from (select run, experiment, metric, max(value) as best from metrics group by run, experiment, metric) as b group by metric

-- agree: subquery without a name
select count(*) from (select distinct run, metric from metrics)

-- agree: columns of a subquery renamed
select b from (select latent, seed from runs) as t(a, b) where a > 16

-- agree: limit in a subquery
select count(*) as n, max(value) as m from (select value from metrics where value is not null order by value limit 10) as t

-- agree: with
with best as (select run, experiment, min(value) as least from epochs where term = 'total' group by run, experiment) select count(*) as n, avg(least) as a from best

-- agree: with, one after the other
with a as (select run, experiment, max(epoch) as last from epochs group by run, experiment), b as (select last, count(*) as n from a group by last) select * from b order by last

-- agree: with hides a table
with metrics as (select * from epochs where epoch = 1) select count(*) as n, max(term) as t from metrics

-- agree: with in a subquery
select n from (with m as (select count(*) as n from metrics) select n + 1 as n from m) as t

-- agree: with, used twice
with r as (select run, experiment, latent from runs) select count(*) as n from r as a join r as b on a.latent = b.latent

-- agree: columns of with renamed
with t(a, b) as (select latent, seed from runs) select sum(a) as s, b from t group by b

-- agree: a subquery as a value
select count(*) as n from metrics where value > (select avg(value) from metrics where metric = 'r2')

-- agree: a subquery in select
select metric, (select max(epoch) from epochs) as last, avg(value) - (select avg(value) from metrics) as a from metrics group by metric

-- agree: a subquery without rows is null
select (select value from metrics where false) as a, count(*) as n from metrics where latent = (select max(latent) from runs where false)

-- agree: in a subquery
select count(*) as n from metrics where run in (select run from epochs where value > 3)

-- agree: not in a subquery
select count(*) as n from metrics where metric not in (select metric from metrics where index is not null)

-- agree: not in a subquery with nulls
select count(*) as n from metrics where direction not in (select direction from metrics)

-- agree: in a subquery without rows
select count(*) as n from metrics where index in (select seed from runs where false) or index not in (select seed from runs where false)

-- agree: exists
select count(*) as n from runs where exists (select 1 from epochs where value > 3)

-- agree: not exists
select count(*) as n from runs where not exists (select 1 from epochs where value > 1e9) and exists (select null)

-- agree: join
select r.run, r.dataset, count(*) as n from runs r join metrics m on m.run = r.run and m.experiment = r.experiment group by r.run, r.dataset

-- agree: join with using
select run, experiment, count(*) as n, max(prediction_seconds) as s from runs join epochs using (run, experiment) group by run, experiment

-- agree: columns of using stand once
select * from (select 1 as a, 2 as b) x join (select 1 as a, 3 as c) y using (a)

-- agree: join of a table with itself
select a.run, a.experiment, a.value - b.value as gap from metrics a join metrics b on a.run = b.run and a.experiment = b.experiment and a.task = b.task and a.model = b.model and a.modality = b.modality where a.metric = 'mae' and b.metric = 'rmse' and a.index is null and b.index is null and a.direction is null and b.direction is null

-- agree: both columns of a name
select a.value, b.value from metrics a join metrics b on a.run = b.run and a.experiment = b.experiment and a.index = b.index and a.modality = b.modality and a.task = b.task where a.metric = 'r2' and b.metric = 'mae' and a.model = 'ridge' and b.model = 'ridge'

-- agree: nulls don't join
select count(*) as n from (select distinct index from metrics) a join (select distinct index from metrics) b on a.index = b.index

-- agree: left join
select a.metric, b.n from (select distinct metric from metrics) a left join (select metric, count(*) as n from metrics where index = 3 group by metric) b on a.metric = b.metric

-- agree: left join and where a partner lacks
select count(*) as n from (select distinct index from metrics) a left join (select 3 as index, 'x' as x) b using (index) where x is null

-- agree: left join with a constant
select a.run, b.latent from runs a left join runs b on a.run = b.run and a.experiment = b.experiment and b.latent = 16

-- agree: left join with a condition on the left
select a.run, b.run from runs a left join runs b on a.run = b.run and a.experiment = b.experiment and a.latent = 16

-- agree: left join on a constant alone
select a.s, b.m from (select distinct scenario as s from runs) a left join (select distinct metric as m from metrics) b on b.m = 'r2'

-- agree: left join on nothing
select a.s, b.m from (select distinct scenario as s from runs) a left join (select distinct metric as m from metrics) b on false

-- agree: left join with a comparison
select a.latent, b.latent from (select distinct latent from runs) a left join (select distinct latent from runs) b on a.latent < b.latent

-- agree: right join
select a.x, b.metric from (select 'r2' as metric, 1 as x union all select 'zz', 2) a right join (select distinct metric from metrics) b on a.metric = b.metric

-- agree: full join
select a.x, a.metric, b.metric from (select 'r2' as metric, 1 as x union all select 'zz', 2) a full join (select distinct metric from metrics) b on a.metric = b.metric

-- agree: full join with using
select metric, x from (select 'r2' as metric, 1 as x union all select 'zz', 2) a full outer join (select distinct metric from metrics) b using (metric) order by metric

-- agree: full join with another condition
select a.l, b.l from (select distinct latent as l from runs) a full join (select distinct latent as l from runs) b on a.l = b.l and a.l > 16

-- agree: cross join
select s, l, s || '-' || l as cell from (select distinct scenario as s from runs) cross join (select distinct latent as l from runs)

-- agree: tables side by side
select count(*) as n from runs r, metrics m where r.run = m.run and r.experiment = m.experiment and r.latent > 16

-- agree: three tables side by side
select a.latent, b.latent, c.latent from (select distinct latent from runs) a, (select distinct latent from runs) b, (select distinct latent from runs) c where a.latent < b.latent and b.latent < c.latent

-- agree: three tables joined
select r.run, m.value, e.value from runs r join metrics m on r.run = m.run and r.experiment = m.experiment join epochs e on e.run = r.run and e.experiment = m.experiment where m.metric = 'r2' and m.index is null and m.direction is null and m.model = 'network' and m.task = 'prediction' and m.modality = 'contact_force' and e.epoch = 1 and e.term = 'total' and e.split = 'train' and e.task = 'prediction'

-- agree: join of expressions
select a.latent, b.l from (select distinct latent from runs) a join (select distinct latent / 4 as l from runs) b on a.latent = b.l * 4 and a.latent + 1 > b.l

-- agree: join on integers and real numbers
select count(*) as n from (select distinct latent from runs) a join (select 16.0 as x union all select 64.5) b on a.latent = b.x

-- agree: all columns of one side
select m.* from metrics m join (select 'r2' as name) n on m.metric = n.name where m.index = 1 and m.seed = 0

-- agree: union all
select run from runs union all select run from epochs where epoch = 1 and term = 'total'

-- agree: union
select run from runs union select run from epochs

-- agree: union of integers and real numbers
select 1 as x union all select 2.5 union all select null

-- agree: union goes by place, not by name
select latent as a, seed as b from runs union select seed, latent from runs

-- agree: union with order by and limit
select run, 'a' as kind from runs union all select run, 'b' from runs order by run, kind desc limit 5

-- agree: union of limited queries
(select metric from metrics order by metric, value limit 1) union all (select term from epochs order by term desc limit 1)

-- agree: union keeps nulls once
select index from metrics union select null

-- agree: intersect
select run from runs where latent = 16 intersect select run from epochs

-- agree: except, with nulls
select index from metrics except select 3

-- agree: intersect binds more than union
select 1 as a union select 2 intersect select 3

-- agree: window over a partition
select run, metric, index, value, value - avg(value) over (partition by run, experiment, metric, modality, task, model, direction) as gap from metrics where index is not null and metric = 'r2'

-- agree: windows without an order
select run, seed, count(*) over (partition by scenario) as a, sum(latent) over () as b, min(run) over (partition by seed) as c, stddev(latent) over (partition by scenario) as d, median(latent) over () as e, max(latent) filter (where seed = 0) over (partition by scenario) as f from runs

-- agree: row_number
select run, experiment, row_number() over (partition by scenario order by latent desc, run, experiment) as n from runs

-- agree: rank and dense_rank
select run, latent, rank() over (order by latent) as a, dense_rank() over (order by latent) as b, rank() over (partition by scenario order by seed desc, latent) as c from runs

-- agree: lag and lead
select run, experiment, lag(latent) over (order by run, experiment) as a, lead(latent, 2) over (partition by scenario order by run, experiment) as b, lag(latent, 1, -1) over (order by run, experiment) as c, lead(run, 3, 'none') over (partition by scenario order by run, experiment) as d from runs

-- agree: changes from epoch to epoch
select run, epoch, value - lag(value) over (partition by run, experiment, task order by epoch) as change from epochs where term = 'total' and split = 'validation'

-- agree: first_value and last_value
select run, first_value(run) over (partition by scenario order by latent, run, experiment) as a, last_value(latent) over (partition by scenario order by latent) as b, last_value(run) over (partition by scenario order by latent, run, experiment rows between unbounded preceding and unbounded following) as c from runs

-- agree: a running sum goes to the last equal row
select run, latent, sum(latent) over (order by latent) as a, count(*) over (order by latent) as b, avg(prediction_seconds) over (partition by scenario order by latent) as c, min(prediction_seconds) over (order by latent desc) as d, max(seed) over (partition by scenario order by latent) as e from runs

-- agree: a running sum by rows
select run, experiment, sum(latent) over (order by run, experiment rows between unbounded preceding and current row) as a, count(reconstruction_seconds) over (order by run, experiment rows unbounded preceding) as b, max(prediction_seconds) over (partition by scenario order by run, experiment rows between unbounded preceding and current row) as c from runs

-- agree: a running sum with nulls
select metric, index, sum(index) over (partition by metric order by index nulls first) as a, avg(index) over (partition by metric order by index nulls first) as b, max(index) over (partition by metric order by index) as c, count(index) over (partition by metric order by index desc) as d from (select distinct metric, index from metrics)

-- agree: the whole partition, written out
select run, sum(latent) over (partition by scenario order by run rows between unbounded preceding and unbounded following) as a from runs

-- agree: a window in an expression, and order by a window
select run, experiment, 100.0 * prediction_seconds / sum(prediction_seconds) over (partition by scenario) as share from runs order by rank() over (order by prediction_seconds desc)

-- agree: a window of groups
select scenario, latent, count(*) as n, sum(count(*)) over (partition by scenario) as all_of_scenario, rank() over (order by avg(value) desc) as place from metrics where metric = 'r2' group by scenario, latent

-- agree: the best of each, by a subquery
select run, metric, value from (select run, experiment, metric, value, row_number() over (partition by metric order by value desc, run, experiment, modality, task, model, index, direction) as place from metrics where value is not null) as t where place <= 2

-- agree: the best of each, by qualify
select run, experiment, prediction_seconds from runs qualify row_number() over (partition by scenario order by prediction_seconds) = 1

-- agree: a window before order by and limit
select run, experiment, row_number() over (order by run, experiment) as n from runs order by n desc limit 3

-- agree: text of dates compares as text
select run, started from runs where started >= '2026-01-01' and substr(started, 1, 4) = '2026' order by started, run, experiment

-- agree: predictions
select modality, index, avg(abs(reference - predicted)) as mae, sqrt(avg(power(reference - predicted, 2))) as rmse from predictions group by modality, index

-- agree: forces
select scenario, sum(case when index >= 15 then mean end) / sum(mean) as share, max(max) as most, max(100.0 * contacts / samples) as percent from forces where modality = 'contact_force' and episode is null group by scenario

-- agree: columns named like functions
select max(max) as max, min(mean) as min, avg("max") as "avg" from forces

-- agree: names in double quotes
select latent as "the latent size", "run" from runs order by "the latent size", "run", experiment

-- agree: comments
select count(*) /* of all */ as n -- to the end of the line
from metrics

-- agree: a semicolon at the end
select count(*) as n from runs;

-- refuse: an ungrouped column beside an aggregate | 'metric' must be in GROUP BY or in an aggregate, such as max(metric)
select metric, avg(value) from metrics

-- refuse: an ungrouped column of a group | 'run' must be in GROUP BY
select metric, run, avg(value) from metrics group by metric

-- refuse: an ungrouped column in an expression | 'latent' must be in GROUP BY
select metric, latent + 1, avg(value) from metrics group by metric

-- refuse: all columns of groups | must be in GROUP BY
select * from metrics group by metric

-- refuse: an ungrouped column in having | 'value' must be in GROUP BY
select metric from metrics group by metric having value > 1

-- refuse: an ungrouped column in order by | 'value' must be in GROUP BY
select metric from metrics group by metric order by value

-- refuse: an aggregate in where | 'avg(value)' can't be in WHERE; use HAVING
select metric from metrics where avg(value) > 1 group by metric

-- refuse: an aggregate in group by | can't be in GROUP BY
select max(value) as m from metrics group by m

-- refuse: an aggregate in an aggregate | can't be in an aggregate; compute it in a query of its own, with WITH
select max(avg(value)) from metrics

-- refuse: a window in where | can't be in WHERE; compute it in a query of its own, with WITH
select run from runs where row_number() over (order by run) = 1

-- refuse: a moving frame | the frame 'ROWS BETWEEN 2 PRECEDING AND CURRENT ROW' is not supported
select avg(value) over (order by epoch rows between 2 preceding and current row) from epochs

-- refuse: a running median | a running median is not supported
select median(value) over (partition by run order by epoch) from epochs

-- refuse: a running deviation | a running stddev is not supported
select stddev(value) over (order by epoch) from epochs

-- refuse: a rank without an order | rank needs an order: OVER (ORDER BY …)
select rank() over (partition by scenario) from runs

-- refuse: row_number without a window | row_number needs OVER (ORDER BY …)
select row_number() from runs

-- refuse: a named window | write OVER (PARTITION BY … ORDER BY …)
select sum(latent) over w from runs window w as (order by seed)

-- refuse: a misspelled table | there is no table 'metric'; did you mean 'metrics'? There are runs, epochs
select * from metric

-- refuse: an unknown table | there is no table 'nope'; there are runs, epochs, metrics, predictions, forces, frames, episodes
select * from nope

-- refuse: a misspelled column | there is no column 'valeu'; did you mean 'value'?
select valeu from metrics

-- refuse: a misspelled column of a table | there is no column 'runn'; did you mean 'run'?
select m.runn from metrics m

-- refuse: a table that is not in from | there is no table 'metrics' in its FROM; there are m
select metrics.value from metrics m

-- refuse: text in double quotes | Write text in single quotes: 'r2'
select * from metrics where metric = "r2"

-- refuse: a column of both sides | 'run' is ambiguous; write a.run or b.run
select run from runs a join epochs b on a.run = b.run

-- refuse: a table twice without names | 'runs' is in FROM twice; give it two names: FROM runs AS a JOIN runs AS b
select count(*) from runs join runs on runs.run = runs.run

-- refuse: text compared with a number | 'latent = '16'' mixes an integer with text; write text in quotes, and numbers without
select * from runs where latent = '16'

-- refuse: a number as a condition | not a condition
select * from runs where latent

-- refuse: arithmetic with text | 'metric' is text
select metric + 1 from metrics

-- refuse: an average of text | avg takes a number, not text
select avg(metric) from metrics

-- refuse: case of text and numbers | mixes
select case when index = 1 then 'x' else 2 end from metrics

-- refuse: union of text and numbers | UNION of text with an integer in column 1
select run from runs union select latent from runs

-- refuse: union of other widths | UNION needs queries with the same number of columns; they have 1 and 2
select run from runs union select run, latent from runs

-- refuse: a real number cast to an integer | choose how to round it: cast(round(…) as integer)
select cast(value as integer) from metrics

-- refuse: a real number cast to text | a real number can't be cast to text
select cast(value as varchar) from metrics

-- refuse: text that is no number | 'r2' is not a number; TRY_CAST returns null instead
select cast(metric as double) from metrics where metric = 'r2'

-- refuse: an integer out of range | '10000000000' is not an integer from -2147483648 to 2147483647
select cast(10000000000 as integer)

-- refuse: integers that overflow | 9223372036854775807 + 1 is not a 64-bit integer; make one of them real
select 9223372036854775807 + 1

-- refuse: columns that overflow | is not a 64-bit integer; make one of them real
select latent * 9223372036854775807 from runs

-- refuse: a sum that overflows | too large for 64 bits; make them real
select sum(latent * 0 + 9223372036854775807) from runs

-- refuse: a sum over a partition that overflows | too large for 64 bits; make them real
select sum(latent * 0 + 9223372036854775807) over () from runs

-- refuse: a running sum that overflows | too large for 64 bits; make them real
select sum(latent * 0 + 9223372036854775807) over (order by run) from runs

-- agree: a running mean of large integers
select run, avg(latent * 0 + 4611686018427387904) over (order by experiment, run) from runs

-- agree: sums over partitions and rows
select run, sum(latent) over (), sum(latent) over (partition by experiment),
    sum(latent) over (order by experiment, run) from runs

-- refuse: an absolute value that overflows | abs(-9223372036854775808) is too large for 64 bits; make it real
select abs(x) from (select -9223372036854775807 - 1 as x)

-- refuse: two columns of a subquery with the same name | 'a' is ambiguous; give them different names with AS
select a from (select 1 as a, 2 as a) s

-- refuse: a remainder of zero | 5 % 0 has no value, because the divisor is 0; leave out such rows, or write nullif(…, 0)
select 5 % 0

-- refuse: an unknown function | there is no function 'coalesc'; did you mean 'coalesce'?
select coalesc(value, 0) from metrics

-- refuse: a wrong number of arguments | sqrt takes 1 value(s), not 2
select sqrt(1, 2)

-- refuse: a place before the text's beginning | substr takes a text, a position from 1 on
select substr(run, 0, 3) from runs

-- refuse: several columns in in | compares several columns at once; compare each with AND, or join
select * from metrics where (run, metric) in (select run, metric from metrics)

-- refuse: exists of the query around it | 'm.run' is a column of the outer query, which a subquery can't use; write a join instead
select count(*) from metrics m where exists (select 1 from epochs e where e.run = m.run)

-- refuse: a value of the query around it | write a join instead
select run, (select max(value) from epochs where epochs.run = runs.run) from runs

-- refuse: a subquery of several rows as a value | gives several rows instead of one value; use IN, or an aggregate such as max
select * from runs where latent = (select latent from runs)

-- refuse: a subquery of several columns as a value | gives 2 columns instead of one
select * from runs where latent in (select latent, seed from runs)

-- refuse: what the parser takes for something else | is ambiguous; add parentheses
select count(*) from runs where git_dirty is distinct from true and latent = 4

-- refuse: any | use IN, or compare with max or min
select * from runs where latent > any (select latent from runs)

-- refuse: dates | 'started' is text such as 2026-01-31T12:00:00Z
select date '2026-01-01' from runs

-- refuse: parts of dates | 'started' is text such as 2026-01-31T12:00:00Z
select extract(year from started) from runs

-- refuse: rollup | combine several queries with UNION ALL
select metric, count(*) from metrics group by rollup (metric)

-- refuse: grouping sets | combine several queries with UNION ALL
select metric, count(*) from metrics group by grouping sets ((metric), ())

-- refuse: distinct on | use QUALIFY row_number() OVER (…) = 1
select distinct on (metric) metric, value from metrics

-- refuse: distinct, ordered by something else | with DISTINCT, ORDER BY can only use columns of SELECT
select distinct metric from metrics order by value

-- refuse: natural join | name the columns: JOIN … USING (…)
select * from runs natural join epochs

-- refuse: join without a condition | ON a.column = b.column
select * from runs join epochs

-- refuse: recursion | WITH RECURSIVE is not supported
with recursive t as (select 1 as n union all select n + 1 from t) select * from t

-- refuse: values | write SELECT 1 AS a UNION ALL SELECT 2
values (1), (2)

-- refuse: order by a number beyond select | SELECT has no column 3; its columns are 1 to 1
select run from runs order by 3

-- refuse: an ambiguous name in order by | several columns of SELECT are named 'x'; order by their number
select latent as x, seed as x from runs order by x

-- refuse: integer division | use floor(a / b)
select latent // 2 from runs

-- refuse: regular expressions | use LIKE
select * from metrics where metric similar to 'r.*'

-- refuse: escapes in like | LIKE with ESCAPE or ANY
select * from metrics where metric like 'a!_%' escape '!'

-- refuse: a join of all with all | a join in it has
select count(*) from metrics a cross join metrics b

-- refuse: tables side by side without a condition | are allowed; join by more columns with ON
select count(*) from predictions, metrics

-- refuse: a join by a column with few values | are allowed; join by more columns with ON
select count(*) from metrics a join metrics b on a.scenario = b.scenario

-- refuse: limit by an expression | LIMIT and OFFSET take whole numbers
select run from runs limit 1 + 1

-- refuse: other files | is not a table, and other files can't be read; the tables are runs, epochs
select * from read_csv('x.csv')

-- refuse: a change | it is not a query; use SELECT, WITH, SHOW TABLES, DESCRIBE or EXPLAIN
delete from runs
