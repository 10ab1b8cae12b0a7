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
select abs(-3) as a, abs(-2.5) as b, abs(null) as c

-- agree: halves round away from zero
select round(0.5::double) as a, round(1.5::double) as b, round(2.5::double) as c, round(-2.5::double) as d, round(7) as e

-- agree: round to decimals
select round(value, 2) as a, round(value, 0) as b, round(value) as c from metrics where metric = 'smape'

-- agree: floor, ceil, trunc
select floor(value) as a, ceil(value) as b, ceil(-value) as c, trunc(-value) as d from metrics where metric = 'smape' and index = 1

-- agree: floor of pairs
select distinct index, floor(index / 2) as pair from metrics

-- agree: roots and powers
select sqrt(2) as a, floor(2.7) as b, power(2, 10) as c, pow(2, 0.5) as d, sqrt(latent) as e, exp(1) as f from runs

-- agree: logarithms
select ln(10) as a, log10(1000) as b, log2(8) as c, log10(100) as d, floor(log10(1000)) as e

-- agree: logarithms of columns
select run, ln(parameters) as a, log10(parameters) as b, log2(latent) as c from runs

-- agree: what is no real number
select isnan(sqrt(-1.0::double)) as a, isinf(-ln(0.0::double)) as b, isfinite(1 / 3) as c, sqrt(null) as d

-- agree: angles
select sin(1) as a, cos(1) as b, atan2(1, -1) as c, degrees(1.5) as d, radians(90) as e

-- agree: greatest and least leave nulls out
select greatest(1, null, 3) as a, least(2, null, 1) as b, greatest(1.5, 2) as c, least(null, null) as d, greatest(latent, 50) as e, least(value, 0.5) as f from metrics where index = 2 and metric = 'r2'

-- agree: NaN is greater than numbers
select greatest(1.0::double, 0 / 0) as a, least(1.0::double, 0 / 0) as b

-- agree: coalesce, ifnull, nullif
select distinct coalesce(direction, 'both') as a, coalesce(index, -1) as b, nullif(index, 3) as c, coalesce(null, index, 7) as d from metrics

-- agree: nullif with a null
select nullif(1, null) as a, nullif(null, 1) as b, nullif('a', 'a') as c

-- agree: nullif against division by zero
select run, sum(value) / nullif(count(value), 0) as mean from metrics where metric = 'r2' group by run

-- agree: upper, lower, length
select distinct upper(metric) as a, lower('ÄBC') as b, length(metric) as c, length('äöü') as d, length('') as e from metrics

-- agree: substr
select distinct substr(run, 1, 5) as a, substr(run, 3) as b, substr(metric, 2, 1) as c, substr('hello', 2, 3) as d, substr('hello', 9) as e from metrics

-- agree: left, right
select left('hello', 2) as a, right('hello', 2) as b, left('äöü', 1) as c, right('hello', 0) as d, left('hi', 9) as e

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
select distinct cast(replace(split_part(run, '-', 2), 'z', '') as integer) as latent from runs where latent is not null

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

-- agree: the value of the row in which another value is smallest or largest
select experiment, run, task, arg_min(epoch, value) as a, arg_max(epoch, value) as b from epochs where split = 'validation' and term = 'total' group by experiment, run, task

-- agree: the same, with rows in which one of the two values is null
select experiment, scenario, arg_min(case when latent > 4 then run end, prediction_seconds) as a, arg_max(run, case when latent < 64 then prediction_seconds end) as b, arg_min(status, prediction_seconds) filter (where latent = 16) as c, arg_max(latent > 4, prediction_seconds) as d from runs group by experiment, scenario

-- agree: the same, without a row
select arg_min(value, index) as a, arg_max(metric, value) as b from metrics where false

-- refuse: one value of arg_min | arg_min takes two values: the one to return, and the one to compare
select arg_min(value) from metrics

-- refuse: arg_max over a window | arg_max can't have OVER
select arg_max(value, index) over () from metrics

-- agree: spread
select stddev(value) as a, variance(value) as b from metrics where metric = 'smape'

-- agree: spread of one
select stddev(seed) as a, variance(seed) as b, median(seed) as c from (select seed from runs order by run limit 1)

-- agree: median and quantiles
select metric, median(value) as a, quantile_cont(value, 0.25) as b, quantile_cont(value, 0.9) as c, quantile_cont(index, 0) as d from metrics group by metric

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

-- agree: the best epoch of each run
select experiment, run, epoch, value from (select experiment, run, epoch, value, row_number() over (partition by experiment, run order by value, epoch) as place from epochs where task = 'prediction' and split = 'validation' and term = 'total') as e where place = 1

-- agree: the best epoch of each run, by qualify
select experiment, run, epoch, value from epochs where task = 'prediction' and split = 'validation' and term = 'total' qualify row_number() over (partition by experiment, run order by value, epoch) = 1

-- agree: the best epoch of each run, by a join with the least value
with best as (select experiment, run, min(value) as least from epochs where task = 'prediction' and split = 'validation' and term = 'total' group by experiment, run) select b.experiment, b.run, min(e.epoch) as epoch, b.least from best b join epochs e on e.experiment = b.experiment and e.run = b.run and e.value = b.least where e.task = 'prediction' and e.split = 'validation' and e.term = 'total' group by b.experiment, b.run, b.least

-- agree: the last epoch of each run
select experiment, run, max(epoch) as last from epochs where task = 'prediction' group by experiment, run having max(epoch) > 50

-- agree: how far the best epoch is from the last
with e as (select experiment, run, epoch, row_number() over (partition by experiment, run order by value, epoch) as place, max(epoch) over (partition by experiment, run) as last from epochs where task = 'prediction' and split = 'validation' and term = 'total') select experiment, avg(last - epoch) as early, min(last - epoch) as least, max(last - epoch) as most from e where place = 1 group by experiment

-- agree: the gap between training and validation
select t.experiment, t.run, t.epoch, v.value - t.value as gap from epochs t join epochs v on v.experiment = t.experiment and v.run = t.run and v.task = t.task and v.epoch = t.epoch and v.term = t.term where t.split = 'train' and v.split = 'validation' and t.term = 'total' and t.task = 'prediction' and t.experiment = 'which_sense'

-- agree: both losses beside each other, by case
select experiment, run, epoch, max(case when split = 'train' then value end) as train, max(case when split = 'validation' then value end) as validation from epochs where term = 'total' and task = 'prediction' and experiment = 'missing' group by experiment, run, epoch order by experiment, run, epoch

-- agree: both losses beside each other, by filter
select experiment, run, epoch, max(value) filter (where split = 'train') as train, max(value) filter (where split = 'validation') as validation from epochs where term = 'total' and task = 'prediction' and experiment = 'missing' group by experiment, run, epoch

-- agree: the ratio of the losses at the end
with last as (select experiment, run, max(epoch) as epoch from epochs where task = 'prediction' group by experiment, run) select e.experiment, e.run, max(case when split = 'validation' then value end) / nullif(max(case when split = 'train' then value end), 0) as ratio from epochs e join last l on l.experiment = e.experiment and l.run = e.run and l.epoch = e.epoch where e.task = 'prediction' and e.term = 'total' group by e.experiment, e.run

-- agree: the share of each term in the total loss
select experiment, term, sum(value) as s, sum(value) / sum(sum(value)) over (partition by experiment) as share from epochs where split = 'train' and task = 'prediction' and term <> 'total' group by experiment, term

-- agree: the time of each run's epochs
select experiment, run, task, sum(seconds) as seconds, avg(seconds) as mean, count(*) as n from epochs where term = 'total' and split = 'train' group by experiment, run, task

-- agree: the slowest epochs
select experiment, run, task, epoch, seconds from epochs where term = 'total' and split = 'train' order by seconds desc, experiment, run, task, epoch limit 20

-- agree: the epochs that took twice as long as usual
select experiment, run, task, epoch from (select experiment, run, task, epoch, seconds, median(seconds) over (partition by experiment, run, task) as usual from epochs where term = 'total' and split = 'train') as e where seconds > 2 * usual

-- agree: how many epochs improved
with e as (select experiment, run, epoch, value, lag(value) over (partition by experiment, run order by epoch) as before from epochs where task = 'prediction' and split = 'validation' and term = 'total') select experiment, run, sum(case when value < before then 1 else 0 end) as better, sum(case when value > before then 1 else 0 end) as worse from e group by experiment, run

-- agree: the best value so far
select experiment, run, epoch, value, min(value) over (partition by experiment, run order by epoch rows between unbounded preceding and current row) as best from epochs where task = 'prediction' and split = 'validation' and term = 'total' and experiment = 'choose_recommended' and variant like 'change=episodes_%'

-- agree: the epochs at which a run was best so far
select experiment, run, epoch from (select experiment, run, epoch, value, min(value) over (partition by experiment, run order by epoch) as best from epochs where task = 'prediction' and split = 'validation' and term = 'total') e where value = best and experiment like 'choose%'

-- agree: the number of epochs without an improvement at the end
with e as (select experiment, run, epoch, value, min(value) over (partition by experiment, run) as best from epochs where task = 'prediction' and split = 'validation' and term = 'total') select experiment, run, max(epoch) - min(case when value = best then epoch end) as waited from e group by experiment, run

-- agree: the first epoch below a threshold
select experiment, run, min(epoch) as first from epochs where task = 'prediction' and split = 'validation' and term = 'contact_force' and value < 0.5 group by experiment, run

-- agree: runs that never came below a threshold
select r.experiment, r.run from runs r left join (select distinct experiment, run from epochs where split = 'validation' and term = 'total' and task = 'prediction' and value < 0.6) e on e.experiment = r.experiment and e.run = r.run where e.run is null

-- agree: every tenth epoch
select experiment, run, epoch, value from epochs where epoch % 10 = 0 and split = 'validation' and term = 'total' and task = 'prediction' and experiment = 'recommended'

-- agree: means of ten epochs each
select experiment, run, floor((epoch - 1) / 10) * 10 + 1 as first, avg(value) as mean, count(*) as n from epochs where split = 'validation' and term = 'total' and task = 'prediction' and experiment = 'recommended' group by experiment, run, floor((epoch - 1) / 10)

-- agree: curves averaged over seeds
select scenario, latent, epoch, avg(value) as mean, stddev(value) as deviation, count(*) as n from epochs where experiment = 'which_sense' and split = 'validation' and term = 'total' and task = 'prediction' group by scenario, latent, epoch order by scenario, latent, epoch

-- agree: the standard error over seeds
select scenario, latent, stddev(value) / sqrt(count(*)) as error from metrics where experiment = 'which_sense' and task = 'prediction' and model = 'network' and modality = 'contact_force' and metric = 'r2' and index is null and direction is null group by scenario, latent having count(*) > 1

-- agree: an interval of two standard errors
select latent, avg(value) as mean, avg(value) - 2 * stddev(value) / sqrt(count(value)) as low, avg(value) + 2 * stddev(value) / sqrt(count(value)) as high from metrics where experiment = 'recommended' and task = 'prediction' and model = 'network' and metric = 'wmape' and index is null and direction is null and modality = 'contact_force' group by latent order by latent

-- agree: metrics of runs by their settings
select r.architecture, r.split, m.metric, avg(m.value) as mean, count(distinct r.run) as runs from runs r join metrics m on m.experiment = r.experiment and m.run = r.run where m.model = 'network' and m.index is null and m.direction is null group by r.architecture, r.split, m.metric

-- agree: metrics by the number of parameters
select r.parameters, avg(m.value) as r2 from runs r join metrics m using (experiment, run) where m.metric = 'r2' and m.model = 'network' and m.modality = 'contact_force' and m.index is null and m.direction is null and m.task = 'prediction' group by r.parameters order by r.parameters

-- agree: metrics by classes of parameters
select case when r.parameters < 100000 then 'small' when r.parameters < 1000000 then 'medium' else 'large' end as size, count(*) as n, avg(m.value) as mean from runs r join metrics m on m.experiment = r.experiment and m.run = r.run where m.metric = 'r2' and m.model = 'network' and m.index is null and m.direction is null group by size

-- agree: metrics by powers of ten of parameters
select floor(log10(parameters)) as magnitude, count(*) as n, min(parameters) as least, max(parameters) as most from runs group by floor(log10(parameters)) order by magnitude

-- agree: the network beside each baseline
select experiment, run, modality, max(value) filter (where model = 'network') as network, max(value) filter (where model = 'persistence') as persistence, max(value) filter (where model = 'ridge') as ridge, max(value) filter (where model = 'training_mean') as mean from metrics where task = 'prediction' and metric = 'r2' and index is null and direction is null group by experiment, run, modality

-- agree: how many runs beat the baseline
with m as (select experiment, run, modality, max(case when model = 'network' then value end) as network, max(case when model = 'persistence' then value end) as persistence from metrics where task = 'prediction' and metric = 'r2' and index is null and direction is null group by experiment, run, modality) select experiment, modality, count(*) as n, sum(case when network > persistence then 1 else 0 end) as better, avg(network - persistence) as gain from m group by experiment, modality

-- agree: the gain by vision, by a join of two inputs
with v as (select scenario, latent, seed, input, value from metrics where experiment in ('which_sense', 'recommended') and task = 'prediction' and model = 'network' and modality = 'contact_force' and metric = 'wmape' and index is null and direction is null) select a.scenario, a.latent, a.seed, a.value - b.value as gain from v a join v b on a.scenario = b.scenario and a.latent = b.latent and a.seed = b.seed where a.input = 'proprioception' and b.input like '%vision%'

-- agree: paired differences of seeds
select a.experiment, a.scenario, a.seed, a.value - b.value as difference from metrics a join metrics b on a.experiment = b.experiment and a.scenario = b.scenario and a.seed = b.seed and a.metric = b.metric and a.modality = b.modality and a.task = b.task and a.model = b.model and a.variant = b.variant where a.latent > b.latent and a.metric = 'r2' and a.model = 'network' and a.task = 'prediction' and a.index is null and b.index is null and a.direction is null and b.direction is null and a.experiment = 'intervals'

-- agree: the best run of each experiment
select experiment, run, value from metrics where metric = 'r2' and task = 'prediction' and model = 'network' and modality = 'contact_force' and index is null and direction is null qualify row_number() over (partition by experiment order by value desc, run) = 1 order by experiment

-- agree: the three best runs of each scenario
select scenario, experiment, run, value, rank() over (partition by scenario order by value desc) as place from metrics where metric = 'r2' and task = 'prediction' and model = 'network' and modality = 'contact_force' and index is null and direction is null qualify rank() over (partition by scenario order by value desc) <= 3

-- agree: the median run of each cell
with m as (select experiment, scenario, latent, variant, run, value, row_number() over (partition by experiment, scenario, latent, variant order by value, run) as place, count(*) over (partition by experiment, scenario, latent, variant) as n from metrics where metric = 'mae' and task = 'prediction' and model = 'network' and modality = 'contact_force' and index is null and direction is null) select experiment, scenario, latent, variant, run, value from m where place = floor((n + 1) / 2)

-- agree: the range over seeds
select experiment, scenario, latent, variant, max(value) - min(value) as spread, count(distinct seed) as seeds from metrics where metric = 'r2' and model = 'network' and task = 'prediction' and modality = 'contact_force' and index is null and direction is null group by experiment, scenario, latent, variant having count(distinct seed) > 1 order by spread desc, experiment, scenario, latent, variant limit 10

-- agree: the coefficient of variation
select experiment, variant, stddev(value) / avg(value) as variation from metrics where metric = 'mae' and model = 'network' and task = 'prediction' and modality = 'contact_force' and index is null and direction is null group by experiment, variant having count(value) > 2

-- agree: quartiles of a metric over runs
select metric, quantile_cont(value, 0.25) as q1, median(value) as q2, quantile_cont(value, 0.75) as q3, quantile_cont(value, 0.75) - quantile_cont(value, 0.25) as width from metrics where model = 'network' and index is null and direction is null group by metric

-- agree: deciles of errors
select index, quantile_cont(abs(reference - predicted), 0.1) as p10, quantile_cont(abs(reference - predicted), 0.9) as p90 from predictions where modality = 'contact_force' group by index order by index

-- agree: the largest errors of a run
select experiment, run, episode, sample, index, abs(reference - predicted) as error from predictions where modality = 'contact_force' order by error desc, experiment, run, episode, sample, index limit 25

-- agree: mean error by episode
select experiment, run, episode, avg(abs(predicted - reference)) as mae, max(abs(predicted - reference)) as worst from predictions where modality = 'contact_force' and task = 'prediction' group by experiment, run, episode

-- agree: the worst episode of each run
select experiment, run, episode, mae from (select experiment, run, episode, avg(abs(predicted - reference)) as mae from predictions where modality = 'contact_force' and task = 'prediction' group by experiment, run, episode) as e qualify row_number() over (partition by experiment, run order by mae desc, episode) = 1

-- agree: r2 from predictions
select experiment, run, modality, 1 - sum(power(reference - predicted, 2)) / sum(power(reference - mean, 2)) as r2 from (select *, avg(reference) over (partition by experiment, run, task, modality) as mean from predictions) as p where task = 'prediction' group by experiment, run, modality

-- agree: r2 from predictions by a join with means
with means as (select experiment, run, modality, index, avg(reference) as mean from predictions where task = 'prediction' group by experiment, run, modality, index) select p.experiment, p.run, p.modality, 1 - sum((p.reference - p.predicted) * (p.reference - p.predicted)) / nullif(sum((p.reference - m.mean) * (p.reference - m.mean)), 0) as r2 from predictions p join means m on m.experiment = p.experiment and m.run = p.run and m.modality = p.modality and m.index = p.index where p.task = 'prediction' group by p.experiment, p.run, p.modality

-- agree: bias of predictions
select run, index, avg(predicted - reference) as bias from predictions where modality = 'proprioception' and task = 'prediction' group by run, index having abs(avg(predicted - reference)) > 0.001

-- agree: correlation from sums
select run, (count(*) * sum(reference * predicted) - sum(reference) * sum(predicted)) / nullif(sqrt(count(*) * sum(reference * reference) - power(sum(reference), 2)) * sqrt(count(*) * sum(predicted * predicted) - power(sum(predicted), 2)), 0) as r from predictions where modality = 'contact_force' and task = 'prediction' group by run

-- agree: errors by the size of the force
select case when reference = 0 then 'none' when reference < 1 then 'small' when reference < 10 then 'medium' else 'large' end as force, count(*) as n, avg(abs(reference - predicted)) as mae from predictions where modality = 'contact_force' group by force order by n desc

-- agree: a histogram of errors
select floor(abs(reference - predicted) / 0.5) * 0.5 as error, count(*) as n from predictions where modality = 'contact_force' group by 1 order by 1

-- agree: a histogram with open ends
select least(greatest(floor(value * 10), -10), 10) as bin, count(*) as n from metrics where metric = 'r2' and model = 'network' and value is not null group by bin order by bin

-- agree: cumulative shares of a histogram
with h as (select floor(reference) as bin, count(*) as n from predictions where modality = 'contact_force' group by 1) select bin, n, sum(n) over (order by bin) as upto, 1.0 * sum(n) over (order by bin) / sum(n) over () as share from h order by bin

-- agree: true and false positives of contact
select run, sum(case when reference > 0.1 and predicted > 0.1 then 1 else 0 end) as hits, sum(case when reference <= 0.1 and predicted > 0.1 then 1 else 0 end) as alarms, sum(case when reference > 0.1 and predicted <= 0.1 then 1 else 0 end) as misses from predictions where modality = 'contact_force' and task = 'prediction' group by run

-- agree: precision and recall of contact
with c as (select run, count(*) filter (where reference > 0.1 and predicted > 0.1) as hits, count(*) filter (where predicted > 0.1) as said, count(*) filter (where reference > 0.1) as there from predictions where modality = 'contact_force' and task = 'prediction' group by run) select run, hits / nullif(said, 0) as precision, hits / nullif(there, 0) as recall from c

-- agree: samples with a force on several links
select run, episode, sample, count(*) as links, sum(reference) as force from predictions where modality = 'contact_force' and task = 'prediction' and reference > 0.01 group by run, episode, sample having count(*) >= 2

-- agree: the link with the largest force of each sample
select run, episode, sample, index, reference from predictions where modality = 'contact_force' and task = 'prediction' and run = (select min(run) from predictions) qualify row_number() over (partition by run, episode, sample order by reference desc, index) = 1

-- agree: force of the base half and of the tip half
select scenario, sum(mean) filter (where index < 10) as base, sum(mean) filter (where index >= 10) as tip, sum(mean) filter (where index >= 10) / sum(mean) as share from forces where modality = 'contact_force' and episode is null group by scenario

-- agree: how often each link is touched
select scenario, index, avg(100.0 * contacts / samples) as percent from forces where modality = 'contact_force' and episode is null group by scenario, index order by scenario, index

-- agree: links that are never touched
select distinct scenario, index from forces where contacts = 0 and episode is null and modality = 'contact_force'

-- agree: links that are touched in every episode
select experiment, run, index from forces where episode is not null and modality = 'contact_force' group by experiment, run, index having min(contacts) > 0

-- agree: whole datasets and their episodes
select episode is null as is_whole, count(*) as n, sum(contacts) as contacts, max(max) as most from forces group by episode is null

-- agree: the dataset's rows against the sum of its episodes
select w.experiment, w.run, w.modality, w.index, w.samples - sum(e.samples) as samples, w.contacts - sum(e.contacts) as contacts from forces w join forces e on e.experiment = w.experiment and e.run = w.run and e.modality = w.modality and e.index = w.index where w.episode is null and e.episode is not null group by w.experiment, w.run, w.modality, w.index, w.samples, w.contacts having w.samples <> sum(e.samples) or w.contacts <> sum(e.contacts)

-- agree: running means over links
select scenario, index, mean, avg(mean) over (partition by experiment, run order by index) as upto from forces where episode is null and modality = 'contact_force' and experiment = 'recommended'

-- agree: ranks of links by force
select experiment, run, index, dense_rank() over (partition by experiment, run order by mean desc, index) as place from forces where episode is null and modality = 'contact_force' and experiment = 'which_sense'

-- agree: runs without any metric
select r.experiment, r.run from runs r where r.run not in (select run from predictions)

-- agree: runs of an experiment that are missing in another
select run from runs where experiment = 'which_sense' except select run from runs where experiment = 'recommended'

-- agree: runs that two experiments share
select run from runs where experiment = 'intervals' intersect select run from runs where experiment = 'intervals'

-- agree: specs that are in several experiments
select spec_hash, count(distinct experiment) as experiments, min(experiment) as first, max(experiment) as last from runs group by spec_hash having count(distinct experiment) > 1

-- agree: groups of runs that differ only in their seed
select group_hash, count(*) as runs, min(seed) as first, max(seed) as last from runs group by group_hash having count(*) > 1 order by runs desc, group_hash

-- agree: seeds that are missing in a group
select g.group_hash, s.seed from (select distinct group_hash from runs where experiment = 'which_sense') g cross join (select distinct seed from runs where experiment = 'which_sense') s left join runs r on r.group_hash = g.group_hash and r.seed = s.seed and r.experiment = 'which_sense' where r.run is null

-- agree: a grid of scenarios and sizes with counts
select s.scenario, l.latent, count(r.run) as n from (select distinct scenario from runs) s cross join (select distinct latent from runs) l left join runs r on r.scenario = s.scenario and r.latent = l.latent group by s.scenario, l.latent order by s.scenario, l.latent

-- agree: datasets and how many runs used them
select dataset, count(*) as n, min(started) as first, max(started) as last from runs group by dataset order by n desc, dataset

-- agree: the time that each experiment took
select experiment, sum(prediction_seconds + coalesce(reconstruction_seconds, 0) + evaluation_seconds) as seconds, count(*) as runs from runs group by experiment order by seconds desc

-- agree: hours and minutes
select experiment, floor(sum(prediction_seconds) / 3600) as hours, floor(mod(sum(prediction_seconds), 3600) / 60) as minutes from runs group by experiment order by experiment

-- agree: the share of time by stage
select experiment, round(100 * sum(prediction_seconds) / sum(prediction_seconds + coalesce(reconstruction_seconds, 0) + evaluation_seconds), 1) as percent from runs group by experiment

-- agree: collect_seconds once for each dataset
select sum(seconds) as s from (select dataset, max(collect_seconds) as seconds from runs group by dataset) as d

-- agree: memory in megabytes
select experiment, max(peak_memory_bytes) / 1e6 as mb, avg(peak_memory_bytes) / (1024 * 1024) as mib from runs group by experiment

-- agree: runs that took much memory
select experiment, run, round(peak_memory_bytes / 1048576.0::double, 1) as mib from runs where peak_memory_bytes > (select quantile_cont(peak_memory_bytes, 0.95) from runs) order by mib desc, experiment, run

-- agree: seconds of an epoch by parameters
select r.experiment, r.run, r.parameters, r.prediction_seconds / e.epochs as seconds from runs r join (select experiment, run, max(epoch) as epochs from epochs where task = 'prediction' group by experiment, run) e on e.experiment = r.experiment and e.run = r.run

-- agree: microseconds of a parameter
select experiment, run, 1e6 * prediction_seconds / parameters as us from runs where parameters > 0 order by us desc, experiment, run limit 10

-- agree: runs with uncommitted changes
select experiment, count(*) filter (where git_dirty) as dirty, count(*) filter (where not git_dirty) as clean, count(*) filter (where git_dirty is null) as unknown from runs group by experiment

-- agree: versions and machines
select harness_version, mujoco_version, candle_version, host, processor, threads, count(*) as n from runs group by all

-- agree: commits and their runs
select substr(git_commit, 1, 8) as "commit", count(*) as runs, min(started) as first from runs group by substr(git_commit, 1, 8) order by first, runs

-- agree: whether a column has nulls
select count(*) - count(reason) as reason, count(*) - count(dataset_seed) as dataset_seed, count(*) - count(reading) as reading, count(*) - count(reconstruction_seconds) as reconstruction from runs

-- agree: statuses
select status, count(*) as n, count(reason) as reasons from runs group by status

-- agree: readings and roles
select reading, role, count(*) as n from runs where reading is not null group by reading, role order by reading, role

-- agree: the readings of a spec, or the base
select coalesce(reading, 'none') as reading, count(*) as n from runs group by coalesce(reading, 'none') order by 2 desc, 1

-- agree: runs by day
select substr(started, 1, 10) as day, count(*) as n, sum(prediction_seconds) / 3600 as hours from runs group by substr(started, 1, 10) order by day

-- agree: runs by hour of the day
select cast(substr(started, 12, 2) as integer) as hour, count(*) as n from runs group by cast(substr(started, 12, 2) as integer) order by hour

-- agree: runs by year and month
select left(started, 4) as year, substr(started, 6, 2) as month, count(*) as n from runs group by 1, 2

-- agree: runs that started on a day
select count(*) as n from runs where started like '2026-11-22%'

-- agree: runs that started between two times
select count(*) as n from runs where started between '2026-11-21T12:00:00Z' and '2026-11-21T18:00:00Z'

-- agree: the minutes since midnight
select experiment, run, cast(substr(started, 12, 2) as integer) * 60 + cast(substr(started, 15, 2) as integer) as minutes from runs where cast(substr(started, 12, 2) as integer) < 3

-- agree: the times without their letters
select replace(replace(started, 'T', ' '), 'Z', '') as started from runs order by 1 limit 5

-- agree: the latest run of each experiment
select experiment, run, started from runs qualify row_number() over (partition by experiment order by started desc, run) = 1

-- agree: the run after each run
select experiment, run, started, lead(started) over (order by started, experiment, run) as next from runs

-- agree: the run before it in the same experiment
select experiment, run, lag(run, 1, 'first') over (partition by experiment order by started, run) as before from runs

-- agree: the order in which runs started
select experiment, run, row_number() over (partition by experiment order by started, run) as place from runs where experiment like 'choose%'

-- agree: names of runs in parts
select run, split_part(run, '-', 1) as scenario, split_part(run, '-', 2) as z, split_part(run, '-', 3) as seed, split_part(run, '-', 4) as hash from runs

-- agree: names of runs that do not begin with their scenario
select run from runs where not starts_with(run, scenario)

-- agree: the sizes in the names and in the column
select run from runs where try_cast(substr(split_part(run, '-', 2), 2) as integer) <> latent

-- agree: the seed in the name, where there is one
select distinct try_cast(replace(split_part(run, '-', 3), 'seed', '') as bigint) as seed from runs order by seed

-- agree: the length of names
select max(length(run)) as longest, min(length(run)) as shortest, avg(length(experiment)) as mean from runs

-- agree: names in capitals
select distinct upper(left(scenario, 1)) || lower(substr(scenario, 2)) as name from runs

-- agree: modalities in the input
select distinct input, contains(input, 'vision') as sees, input like '%proprioception%' as feels, length(input) - length(replace(input, '+', '')) + 1 as modalities from runs

-- agree: the first input
select split_part(input, '+', 1) as first, count(*) as n from runs group by split_part(input, '+', 1)

-- agree: inputs and outputs in one text
select distinct input || ' -> ' || output as task from runs order by task

-- agree: values of settings in the variant
select distinct variant, replace(variant, 'change=episodes_', '') as episodes from runs where experiment = 'choose_recommended' and variant like 'change=episodes_%' order by episodes

-- agree: numbers of settings in the variant
select cast(replace(variant, 'change=episodes_', '') as double) as episodes, count(*) as n from runs where experiment = 'choose_recommended' and variant like 'change=episodes_%' group by episodes order by episodes

-- agree: numbers of settings, where there are any
select variant, try_cast(split_part(variant, '=', 2) as double) as number from runs group by variant

-- agree: settings by their name
select split_part(variant, '=', 1) as setting, count(distinct variant) as values_ from runs where variant <> '' group by 1

-- agree: variants with two settings
select distinct split_part(variant, ',', 1) as first, split_part(variant, ',', 2) as second from runs where contains(variant, ',')

-- agree: an empty variant
select variant = '' as is_base, count(*) as n from runs group by variant = ''

-- agree: the base instead of an empty variant
select case when variant = '' then 'base' else variant end as variant, count(*) as n from runs where experiment in ('recommended', 'missing') group by 1

-- agree: nullif of an empty variant
select coalesce(nullif(variant, ''), 'base') as variant, count(*) as n from runs group by coalesce(nullif(variant, ''), 'base')

-- agree: an alias that renames columns, and a condition on a new name
select count(*) as n, min(a) as least, max(b) as most, max(status) as last from runs r(a, b, c, d) where a = 'recommended' and d <> ''

-- agree: an alias whose new names are those of other columns
select experiment, run, count(*) as n from epochs e(run, experiment) where experiment like 'empty-z%' and run = 'which_sense' group by experiment, run

-- agree: an alias that swaps two columns
select run, term, count(*) as n from epochs as e(experiment, run, scenario, input, output, architecture, latent, variant, seed, term, epoch, split, task, value, seconds) where term = 'prediction' and task = 'total' and split = 'validation' group by run, term

-- agree: an alias that renames the columns of a joined table
select a.run, count(*) as n from runs a join epochs e(x, run, scenario, input, output, architecture, latent, variant, seed, kind, epoch, split, term, value, seconds) on e.x = a.experiment and e.run = a.run where e.kind = 'reconstruction' group by a.run

-- agree: renamed columns of with in a condition
with e(experiment, run, least) as (select run, experiment, min(value) from epochs where term = 'total' group by run, experiment) select run, count(*) as n from e where run = 'missing' group by run

-- agree: text of decimals cast to integers
select try_cast('1.7' as integer) as a, cast('1.7' as integer) as b, try_cast('1.5' as integer) as c, try_cast('2.5' as integer) as d, try_cast('-2.5' as integer) as e, try_cast('1.49' as bigint) as f, try_cast('.5' as integer) as g, try_cast('5.' as integer) as h, try_cast('-0.5' as integer) as i, try_cast('+7' as integer) as j

-- agree: text with exponents cast to integers
select try_cast('1e3' as integer) as a, try_cast('15e-1' as integer) as b, try_cast('25e-1' as integer) as c, try_cast('1e-1' as integer) as d, try_cast('1e30' as bigint) as e, try_cast('12e' as integer) as f

-- agree: text that is no integer
select try_cast('' as integer) as a, try_cast('nan' as integer) as b, try_cast('inf' as bigint) as c, try_cast('z16' as integer) as d, try_cast('1 2' as integer) as e, try_cast('--1' as integer) as f, try_cast('1_000' as integer) as g, try_cast('_1' as integer) as h, try_cast('1_' as integer) as i, try_cast('99999999999' as integer) as j, try_cast('true' as integer) as k

-- agree: text cast to real numbers
select try_cast('nan' as double) as a, try_cast('inf' as double) as b, try_cast('-Infinity' as double) as c, try_cast('1_0' as double) as d, try_cast('' as double) as e, try_cast('+1.' as double) as f, try_cast('1e400' as double) as g, try_cast('x' as double) as h, try_cast('1__0' as double) as i

-- agree: settings of variants as integers
select distinct variant, try_cast(split_part(variant, '=', 2) as integer) as number from runs where variant not like '%,%'

-- agree: a remainder by zero that case excludes
select distinct seed, case when seed <> 0 then 5 % seed end as a, case when seed = 0 then -1 else latent % seed end as b from runs

-- agree: a constant remainder by zero that case excludes
select case when 0 <> 0 then 5 % 0 else 1 end as a, case when true then 2 when 5 % 0 = 1 then 3 end as b, case when false then mod(5, 0) end as c

-- agree: a remainder by zero after a condition that excludes it
select case when seed = 0 then 'none' when 6 % seed = 0 then 'divides' else 'rest' end as a, count(*) as n from runs group by 1

-- agree: a remainder by zero in a case of a value
select distinct case seed when 0 then 0 when 7 % seed then 1 else 8 % seed end as a, seed from runs

-- agree: a remainder by zero within two cases
select distinct seed, case when seed > 0 then case when latent % seed = 0 then latent % seed else latent % (seed + 1) end end as a from runs

-- agree: a remainder by zero in an aggregate, excluded by case
select sum(case when seed > 0 then latent % seed end) as a, max(case when seed = 0 then 0 else 100 % seed end) as b from runs

-- agree: a remainder by an aggregate that case excludes
select experiment, case when min(seed) > 0 then count(*) % min(seed) else 0 end as a from runs group by experiment

-- agree: a remainder by zero that where excludes
select distinct seed, latent % seed as a from runs where seed > 0

-- agree: a condition with a remainder by zero that another excludes
select count(*) as n from runs where seed <> 0 and latent % seed = 0

-- agree: a condition with a remainder by zero before the one that excludes it
select count(*) as n from runs where 4 % seed = 0 and seed <> 0

-- agree: a remainder by zero that an inner query excludes
select count(*) as n from (select * from runs where seed <> 0) as r where 4 % seed = 0

-- agree: a remainder by zero that with excludes
with r as (select run, seed from runs where seed > 0) select seed, count(*) as n from r where 9 % seed < 2 group by seed

-- agree: texts that are no numbers, excluded by case
select distinct variant, case when variant like 'change=episodes_%' then cast(split_part(variant, '_', 2) as integer) end as episodes from runs

-- agree: a remainder by zero that coalesce does not need
select distinct coalesce(latent, 5 % seed) as a, coalesce(1, 5 % 0) as b, coalesce(nullif(seed, 0), seed + 1, 6 % seed) as c from runs where latent is not null

-- agree: a cast that ifnull does not need
select distinct coalesce(try_cast(variant as integer), length(variant)) as a, coalesce(latent, cast(run as integer)) as b from runs where latent is not null

-- agree: texts that are no numbers, excluded by where
select distinct cast(split_part(variant, '_', 2) as integer) as episodes from runs where variant like 'change=episodes_%' and cast(split_part(variant, '_', 2) as integer) > 200

-- agree: texts that are no numbers, excluded by an inner query
select distinct cast(v as double) as episodes from (select split_part(variant, '_', 2) as v from runs where experiment = 'choose_recommended' and variant like 'change=episodes_%') as t where cast(v as double) < 300

-- agree: an overflow that case excludes
select distinct case when latent > 1000 then latent * 9223372036854775807 else latent end as a from runs

-- agree: an integer from a rounded number with no decimals
select distinct cast(round(value) as integer) as a, cast(floor(value * 10) as integer) as b, round(value)::bigint as c from metrics where metric = 'smape' and index = 3

-- agree: rounding to one decimal and to whole numbers
select distinct round(round(value, 1)) as a, cast(round(round(value, 1)) as integer) as b from metrics where metric = 'smape' and index = 3

-- agree: metrics with NaN left out
select avg(x) as a, count(x) as b from (select case when isnan(x) then null else x end as x from (select 0 / 0 as x union all select 1.5 union all select 2.5) as t) as u

-- agree: filter by what is finite
select count(*) as n from (select ln(value) as x from metrics where metric = 'rmse') as t where isfinite(x)

-- agree: infinite logarithms
select count(*) filter (where isinf(x)) as a, count(*) filter (where isnan(x)) as b, count(x) as c from (select ln(value) as x from metrics where metric in ('rmse', 'mae') and value >= 0) as t

-- agree: geometric means
select metric, exp(avg(ln(value))) as mean from metrics where metric in ('mae', 'rmse') and value > 0 group by metric

-- agree: harmonic means
select metric, count(value) / sum(1.0::double / value) as mean from metrics where metric in ('smape') and value > 0 group by metric

-- agree: root mean squares
select metric, sqrt(avg(power(value, 2))) as rms from metrics where metric in ('mae', 'smape') group by metric

-- agree: means weighted by a count
select scenario, sum(mean * samples) / sum(samples) as force from forces where episode is not null and modality = 'contact_force' group by scenario

-- agree: a mean without the extremes
select metric, (sum(value) - min(value) - max(value)) / nullif(count(value) - 2, 0) as trimmed from metrics where model = 'network' and index is null and direction is null and metric <> 'r2' group by metric

-- agree: scores in units of the deviation
select experiment, run, value, (value - avg(value) over (partition by experiment)) / nullif(stddev(value) over (partition by experiment), 0) as z from metrics where metric = 'mae' and model = 'network' and modality = 'contact_force' and task = 'prediction' and index is null and direction is null and experiment = 'which_sense'

-- agree: values more than two deviations from the mean
with m as (select experiment, run, value, avg(value) over (partition by experiment) as mean, stddev(value) over (partition by experiment) as s from metrics where metric = 'smape' and model = 'network' and modality = 'proprioception' and task = 'prediction' and index is null and direction is null) select experiment, run from m where abs(value - mean) > 2 * s

-- agree: values scaled to the range from 0 to 1
select experiment, run, (value - min(value) over (partition by experiment)) / nullif(max(value) over (partition by experiment) - min(value) over (partition by experiment), 0) as scaled from metrics where metric = 'mae' and model = 'network' and modality = 'contact_force' and task = 'prediction' and index is null and direction is null and experiment like 'multi%'

-- agree: the percentage of the best
select experiment, run, round(100 * min(value) over (partition by experiment) / value, 3) as percent from metrics where metric = 'mae' and model = 'network' and modality = 'contact_force' and task = 'prediction' and index is null and direction is null

-- agree: the difference to the best run of the cell
select experiment, scenario, latent, run, value - min(value) over (partition by experiment, scenario, latent) as gap from metrics where metric = 'rmse' and model = 'network' and modality = 'contact_force' and task = 'prediction' and index is null and direction is null

-- agree: the improvement over the previous latent size
with m as (select scenario, latent, avg(value) as mean from metrics where experiment = 'which_sense' and metric = 'r2' and model = 'network' and modality = 'contact_force' and task = 'prediction' and index is null and direction is null group by scenario, latent) select scenario, latent, mean, mean - lag(mean) over (partition by scenario order by latent) as gain from m

-- agree: each metric against that of the smallest network
select scenario, latent, mean, mean / first_value(mean) over (partition by scenario order by latent) as ratio from (select scenario, latent, avg(value) as mean from metrics where experiment = 'recommended' and metric = 'mae' and model = 'network' and modality = 'contact_force' and task = 'prediction' and index is null and direction is null group by scenario, latent) as m

-- agree: metrics of links beside the mean of all
select run, index, value, avg(value) over (partition by run) as mean, value > avg(value) over (partition by run) as above from metrics where experiment = 'intervals' and metric = 'mae' and model = 'network' and modality = 'contact_force' and task = 'prediction' and index is not null

-- agree: the link with the largest error of each run
select experiment, run, index, value from metrics where metric = 'mae' and model = 'network' and modality = 'contact_force' and task = 'prediction' and index is not null qualify rank() over (partition by experiment, run order by value desc) = 1

-- agree: the first three links
select run, sum(value) filter (where index = 0) as l0, sum(value) filter (where index = 1) as l1, sum(value) filter (where index = 2) as l2 from metrics where metric = 'mae' and model = 'network' and modality = 'contact_force' and task = 'prediction' and experiment = 'which_sense' group by run

-- agree: odd and even links
select index % 2 = 0 as even, avg(value) as mean from metrics where metric = 'mae' and modality = 'contact_force' and index is not null group by index % 2 = 0

-- agree: neighboring links
select a.run, a.index, b.value - a.value as step from metrics a join metrics b on a.experiment = b.experiment and a.run = b.run and a.task = b.task and a.model = b.model and a.modality = b.modality and a.metric = b.metric and b.index = a.index + 1 where a.metric = 'mae' and a.model = 'network' and a.modality = 'contact_force' and a.experiment = 'intervals'

-- agree: directions beside each other
select experiment, run, max(case when direction = 'fe' then value end) as fe, max(case when direction = 'aa' then value end) as aa from metrics where metric = 'smape' and model = 'network' and task = 'prediction' and modality = 'proprioception' and index is null and direction is not null group by experiment, run

-- agree: rows of all elements, of a direction and of one element
select case when index is not null then 'element' when direction is not null then 'direction' else 'all' end as level, count(*) as n, count(value) as values_ from metrics group by level

-- agree: where a metric is not defined
select metric, modality, count(*) as n from metrics where value is null group by metric, modality

-- agree: the share of defined values
select metric, 1.0 * count(value) / count(*) as share from metrics group by metric order by share, metric

-- agree: means in which undefined values count as zero
select metric, avg(value) as a, avg(coalesce(value, 0)) as b, sum(value) / count(*) as c from metrics where metric in ('r2', 'wmape') and value is null or value between 0 and 1 group by metric

-- agree: extreme values set to a bound
select metric, avg(greatest(value, -1)) as mean from metrics where metric = 'r2' group by metric

-- agree: units of metrics
select metric, unit, count(*) as n from metrics group by metric, unit order by metric, unit

-- agree: a text for each metric
select distinct case unit when '1' then metric else metric || ' [' || unit || ']' end as label from metrics order by label

-- agree: two metrics in one row
select m.experiment, m.run, m.value as mae, r.value as rmse, r.value / m.value as ratio from metrics m join metrics r on r.experiment = m.experiment and r.run = m.run and r.task = m.task and r.model = m.model and r.modality = m.modality where m.metric = 'mae' and r.metric = 'rmse' and m.index is null and r.index is null and m.direction is null and r.direction is null and m.model = 'network'

-- agree: metrics in columns
select experiment, run, modality, max(case metric when 'r2' then value end) as r2, max(case metric when 'mae' then value end) as mae, max(case metric when 'rmse' then value end) as rmse, max(case metric when 'smape' then value end) as smape from metrics where model = 'network' and task = 'prediction' and index is null and direction is null group by experiment, run, modality

-- agree: scenarios in columns
select experiment, latent, avg(case scenario when 'empty' then value end) as empty, avg(case scenario when 'cluttered' then value end) as cluttered from metrics where metric = 'r2' and model = 'network' and modality = 'contact_force' and task = 'prediction' and index is null and direction is null group by experiment, latent order by experiment, latent

-- agree: seeds in columns
select variant, latent, scenario, min(value) filter (where seed = 0) as s0, min(value) filter (where seed = 1) as s1, min(value) filter (where seed = 2) as s2 from metrics where experiment = 'missing' and metric = 'mae' and model = 'network' and index is null and direction is null and modality = 'contact_force' group by variant, latent, scenario

-- agree: columns in rows
select 'mae' as metric, avg(mean) as value from forces where episode is null union all select 'max', max(max) from forces where episode is null union all select 'contacts', sum(contacts) from forces where episode is null

-- agree: counts of everything in one row
select (select count(*) from runs) as runs, (select count(*) from epochs) as epochs, (select count(*) from metrics) as metrics, (select count(*) from predictions) as predictions, (select count(*) from forces) as forces, (select count(*) from frames) as frames

-- agree: counts of everything in rows
select 'runs' as name, count(*) as n from runs union all select 'epochs', count(*) from epochs union all select 'metrics', count(*) from metrics order by n

-- agree: the rows of a run in each table
select r.run, e.n as epochs, m.n as metrics, p.n as predictions from runs r left join (select experiment, run, count(*) as n from epochs group by experiment, run) e on e.experiment = r.experiment and e.run = r.run left join (select experiment, run, count(*) as n from metrics group by experiment, run) m on m.experiment = r.experiment and m.run = r.run left join (select experiment, run, count(*) as n from predictions group by experiment, run) p on p.experiment = r.experiment and p.run = r.run where r.experiment = 'which_sense'

-- agree: nulls of a left join as zero
select r.experiment, count(*) as runs, sum(coalesce(p.n, 0)) as predictions from runs r left join (select experiment, run, count(*) as n from predictions group by experiment, run) p on p.experiment = r.experiment and p.run = r.run group by r.experiment

-- agree: runs with images
select experiment, run from runs where run in (select run from frames) and experiment in (select experiment from frames) order by experiment, run

-- agree: images and their sizes in samples
select experiment, run, task, modality, count(*) as n, min(sample) as first, max(motion) as motion from frames group by experiment, run, task, modality

-- agree: images with more motion than the mean
select run, modality, episode, sample from frames where motion > (select avg(motion) from frames)

-- agree: how many images have bytes
select modality, count(reference) as reference, count(predicted) as predicted, count(*) as n from frames group by modality

-- agree: two subqueries in a condition
select experiment, run from runs where prediction_seconds > (select avg(prediction_seconds) from runs) and parameters < (select median(parameters) from runs)

-- agree: a subquery in having
select experiment, avg(prediction_seconds) as mean from runs group by experiment having avg(prediction_seconds) > (select avg(prediction_seconds) from runs)

-- agree: a subquery in case
select distinct experiment, case when experiment = (select min(experiment) from runs) then 'first' else 'other' end as place from runs

-- agree: a subquery in a subquery
select count(*) as n from metrics where run in (select run from runs where dataset in (select dataset from runs where experiment = 'intervals'))

-- agree: a subquery in an order
select experiment from runs group by experiment order by abs(count(*) - (select avg(n) from (select count(*) as n from runs group by experiment) as c)), experiment

-- agree: with that is used in a subquery
with best as (select max(value) as value from metrics where metric = 'r2' and model = 'network' and modality = 'contact_force' and index is null and direction is null) select experiment, run from metrics where value = (select value from best) and metric = 'r2'

-- agree: three queries of with, each on the one before
with cells as (select experiment, scenario, latent, variant, avg(value) as mean from metrics where metric = 'r2' and task = 'prediction' and model = 'network' and modality = 'contact_force' and index is null and direction is null group by experiment, scenario, latent, variant), ranked as (select *, rank() over (partition by scenario order by mean desc) as place from cells), best as (select * from ranked where place <= 5) select scenario, count(*) as n, min(mean) as least, max(mean) as most from best group by scenario

-- agree: with of two tables
with r as (select experiment, run, parameters from runs where architecture = 'single_to_multi'), m as (select experiment, run, value from metrics where metric = 'relative_error' and model = 'network' and task = 'prediction' and index is null) select r.experiment, r.run, r.parameters, m.value from r join m on m.experiment = r.experiment and m.run = r.run

-- agree: with whose names are those of functions
with max as (select max(epoch) as max from epochs) select max.max + 1 as next from max

-- agree: the same query of with joined twice
with m as (select run, experiment, seed, scenario, latent, value from metrics where experiment = 'which_sense' and metric = 'mae' and task = 'prediction' and model = 'network' and modality = 'contact_force' and index is null and direction is null) select a.scenario, a.latent, a.seed, b.seed as other, a.value - b.value as difference from m a join m b on a.scenario = b.scenario and a.latent = b.latent and a.seed < b.seed

-- agree: two rows before and after
select experiment, run, epoch, lag(value, 2) over (partition by experiment, run order by epoch) as before, lead(value, 2) over (partition by experiment, run order by epoch) as after from epochs where experiment = 'intervals' and task = 'prediction' and split = 'validation' and term = 'total'

-- agree: relative changes
select experiment, run, epoch, (value - lag(value) over (partition by experiment, run order by epoch)) / lag(value) over (partition by experiment, run order by epoch) as change from epochs where experiment = 'intervals' and task = 'prediction' and split = 'train' and term = 'total'

-- agree: cumulative time
select experiment, run, epoch, sum(seconds) over (partition by experiment, run order by epoch) as time, value from epochs where experiment = 'intervals' and task = 'prediction' and split = 'validation' and term = 'total'

-- agree: the loss after a time
select experiment, run, min(value) as least from (select experiment, run, value, sum(seconds) over (partition by experiment, run order by epoch) as time from epochs where task = 'prediction' and split = 'validation' and term = 'total') as e where time < 60 group by experiment, run

-- agree: the share of epochs that are done by the time
select experiment, run, epoch, 1.0 * row_number() over (partition by experiment, run order by epoch) / count(*) over (partition by experiment, run) as share from epochs where experiment = 'missing' and task = 'prediction' and split = 'train' and term = 'kl'

-- agree: the first and the last loss
select distinct experiment, run, first_value(value) over (partition by experiment, run order by epoch) as first, last_value(value) over (partition by experiment, run order by epoch rows between unbounded preceding and unbounded following) as last from epochs where task = 'prediction' and split = 'train' and term = 'total'

-- agree: windows in a condition of qualify with and
select experiment, run, latent from runs qualify row_number() over (partition by experiment order by run) = 1 and count(*) over (partition by experiment) > 10

-- agree: qualify by a name of select
select experiment, run, rank() over (partition by experiment order by prediction_seconds desc) as place from runs qualify place = 1

-- agree: qualify after groups
select experiment, scenario, count(*) as n from runs group by experiment, scenario qualify row_number() over (partition by experiment order by count(*) desc, scenario) = 1

-- agree: windows over groups of groups
select experiment, variant, avg(prediction_seconds) as mean, avg(avg(prediction_seconds)) over (partition by experiment) as of_experiment, max(count(*)) over () as most from runs group by experiment, variant

-- agree: the cumulative number of runs
select day, n, sum(n) over (order by day) as upto from (select substr(started, 1, 10) as day, count(*) as n from runs group by substr(started, 1, 10)) as d

-- agree: distinct values counted in groups
select experiment, count(distinct scenario) as scenarios, count(distinct latent) as sizes, count(distinct seed) as seeds, count(distinct variant) as variants, count(distinct dataset) as datasets from runs group by experiment order by experiment

-- agree: pairs counted
select count(*) as n from (select distinct scenario, latent from runs) as p

-- agree: distinct pairs counted as text
select count(distinct scenario || '/' || latent) as n, count(distinct concat(experiment, '/', run)) as runs from runs

-- agree: groups with only one scenario
select experiment from runs group by experiment having count(distinct scenario) = 1 order by experiment

-- agree: groups with every seed
select experiment, latent from runs where seed in (0, 1, 2) group by experiment, latent having count(distinct seed) = 3

-- agree: having with case
select experiment from runs group by experiment having sum(case when scenario = 'empty' then 1 else 0 end) = 0

-- agree: having with and, or, not
select experiment, count(*) as n from runs group by experiment having (count(*) > 20 or max(latent) >= 64) and not max(seed) > 3

-- agree: having with between and in
select experiment, count(*) as n from runs group by experiment having count(*) between 3 and 12 and min(latent) in (4, 16, 64)

-- agree: the sum of a condition
select sum(cast(git_dirty as integer)) as dirty, avg(cast(scenario = 'empty' as integer)) as share from runs

-- agree: conditions of groups
select experiment, bool_and(status = 'done') as all_done, bool_or(git_dirty) as any_dirty from runs group by experiment

-- agree: conditions of conditions
select (latent > 16) = (scenario = 'empty') as same, count(*) as n from runs group by 1

-- agree: the order of true, false and null
select distinct index > 3 as a from metrics order by a desc nulls last

-- agree: nulls in several orders
select distinct direction, index from metrics where modality = 'proprioception' and metric = 'mae' order by direction desc nulls first, index asc nulls last

-- agree: an order by case
select metric from metrics group by metric order by case metric when 'r2' then 0 when 'mae' then 1 else 2 end, metric

-- agree: an order by the length of text
select experiment from runs group by experiment order by length(experiment) desc, experiment limit 7

-- agree: an order by a part of the name
select split_part(run, '-', 2) as z from runs group by z order by length(z), z

-- agree: an order by two aggregates
select experiment from runs group by experiment order by max(latent) desc, count(*), experiment

-- agree: an order by a column and by its number
select experiment, latent, seed from runs where experiment like 'multi%' order by experiment, 2 desc, seed

-- agree: pages of an answer
select experiment, run from runs order by experiment, run limit 10 offset 20

-- agree: the last page of an answer
select experiment, run from runs order by experiment desc, run desc limit 5

-- agree: conditions with not, like and in
select count(*) as n from runs where experiment not like 'choose%' and scenario not in ('empty') and not (latent = 16 or seed > 1)

-- agree: conditions on text in any case
select count(*) as n from runs where lower(experiment) like '%multi%' and upper(scenario) = 'EMPTY' and experiment ilike '%MULTI%'

-- agree: an underscore that stands for itself
select distinct experiment from runs where replace(experiment, '_', '-') like '%-to-%'

-- agree: a percent sign in a text
select count(*) as n from metrics where unit = '%'

-- agree: in with one value, and in with a column
select count(*) as n from metrics where metric in ('mae') and 'network' in (model, metric)

-- agree: not in with texts and a null column
select count(*) as n from metrics where direction not in ('fe', 'x')

-- agree: columns that are null or a value
select count(*) as n from metrics where (direction is null or direction = 'aa') and (index is null or index < 2)

-- agree: equal or both null
select count(*) as n from metrics a join metrics b on a.experiment = b.experiment and a.run = b.run and a.task = b.task and a.model = b.model and a.modality = b.modality and a.metric = b.metric and a.index is not distinct from b.index where a.experiment = 'intervals'

-- agree: coalesced keys of a join
select count(*) as n from (select distinct coalesce(index, -1) as i from metrics) a join (select distinct coalesce(index, -1) as i from forces) b on a.i = b.i

-- agree: case without a match is null
select case when false then 1 end as a, case 3 when 4 then 'x' end as b, coalesce(case when false then 1 end, 0) as c

-- agree: arithmetic with seconds
select experiment, run, round(prediction_seconds / 60, 2) as minutes, ceil(prediction_seconds / 60) as upto, prediction_seconds - floor(prediction_seconds / 60) * 60 as rest from runs where prediction_seconds > 300

-- agree: text of integers with leading zeros
select distinct right('000' || latent, 3) as z from runs order by z

-- agree: identifiers made of columns
select distinct scenario || '-z' || latent || '-seed' || seed as id from runs where experiment = 'which_sense' order by id

-- agree: identifiers that begin the run's name
select count(*) as n from runs where run like '%' and starts_with(run, scenario || '-') and contains(run, '-z' || latent || '-')

-- agree: hashes of eight letters
select count(*) as n, min(length(split_part(run, '-', 4))) as least from runs where variant = ''

-- agree: the hash at the end of the name
select distinct length(right(run, 8)) as n, left(right(run, 8), 1) between '0' and 'f' as is_hex from runs

-- agree: parts of the command
select experiment, count(distinct split_part(command, ' ', 3)) as specs, bool_or(contains(command, '--quick')) as quick from runs group by experiment

-- agree: the seeds of datasets
select dataset_seed, count(distinct dataset) as datasets, count(*) as runs from runs group by dataset_seed order by dataset_seed nulls first

-- agree: the scenario in the dataset's name
select distinct split_part(dataset, '-', 1) = scenario as same from runs

-- agree: roles of runs beside their experiments
select coalesce(role, experiment) as counts_for, count(*) as n from runs group by coalesce(role, experiment) order by n desc, counts_for

-- agree: a reading against the base
with m as (select r.reading, m.scenario, m.latent, m.value from metrics m join runs r on r.experiment = m.experiment and r.run = m.run where m.experiment = 'reproduction' and m.metric = 'mae' and m.task = 'prediction' and m.model = 'network' and m.modality = 'contact_force' and m.index is null and m.direction is null) select reading, scenario, latent, avg(value) as mean, count(*) as n from m group by reading, scenario, latent

-- agree: how much a reading changes the metric
with m as (select r.reading, r.role, m.scenario, m.latent, avg(m.value) as mean from metrics m join runs r on r.experiment = m.experiment and r.run = m.run where m.experiment = 'reproduction' and m.metric = 'mae' and m.task = 'prediction' and m.model = 'network' and m.modality = 'contact_force' and m.index is null and m.direction is null group by r.reading, r.role, m.scenario, m.latent) select reading, role, scenario, latent, mean - avg(mean) over (partition by role, scenario, latent) as change, rank() over (partition by role, scenario, latent order by mean) as place from m

-- agree: the last five epochs of each run
select experiment, run, avg(value) as mean from (select experiment, run, epoch, value, max(epoch) over (partition by experiment, run, task) as last from epochs where task = 'prediction' and split = 'validation' and term = 'total') as e where epoch > last - 5 group by experiment, run

-- agree: losses at chosen epochs in columns
select experiment, run, sum(value) filter (where epoch = 1) as e1, sum(value) filter (where epoch = 5) as e5, sum(value) filter (where epoch = 10) as e10 from epochs where task = 'prediction' and split = 'validation' and term = 'total' group by experiment, run

-- agree: the order of runs at the first and at the last epoch
with e as (select experiment, run, epoch, value, max(epoch) over (partition by experiment, run) as last from epochs where task = 'prediction' and split = 'validation' and term = 'total' and experiment = 'which_sense') select a.run, rank() over (order by a.value) as first, rank() over (order by b.value) as last from e a join e b on a.experiment = b.experiment and a.run = b.run where a.epoch = 1 and b.epoch = b.last

-- agree: terms that grew between the first and the last epoch
with e as (select experiment, run, task, term, split, epoch, value, max(epoch) over (partition by experiment, run, task) as last from epochs) select experiment, run, task, term, split from e group by experiment, run, task, term, split having max(case when epoch = last then value end) > max(case when epoch = 1 then value end)

-- agree: runs with the same number of epochs
select epochs, count(*) as runs from (select experiment, run, max(epoch) as epochs from epochs where task = 'prediction' group by experiment, run) as e group by epochs order by epochs

-- agree: terms of each task
select distinct task, term from epochs order by task, term

-- agree: the loss of the two tasks beside each other
select p.experiment, p.run, p.value as prediction, r.value as reconstruction from epochs p join epochs r on r.experiment = p.experiment and r.run = p.run and r.epoch = p.epoch and r.split = p.split and r.term = p.term where p.task = 'prediction' and r.task = 'reconstruction' and p.epoch = 1 and p.term = 'total' and p.split = 'train'

-- agree: seconds without the first epoch
select experiment, run, avg(seconds) filter (where epoch > 1) as usual, max(seconds) filter (where epoch = 1) as first from epochs where term = 'total' and split = 'train' and task = 'prediction' group by experiment, run

-- agree: quantiles of losses with a filter
select experiment, quantile_cont(value, 0.5) filter (where split = 'train') as train, quantile_cont(value, 0.5) filter (where split = 'validation') as validation from epochs where term = 'total' group by experiment

-- agree: medians of differences
select median(v.value - t.value) as gap from epochs t join epochs v using (experiment, run, task, epoch, term) where t.split = 'train' and v.split = 'validation' and t.term = 'kl'

-- agree: using with five columns keeps the others
select experiment, run, epoch, t.split, v.split from epochs t join epochs v using (experiment, run, task, epoch, term) where t.split = 'train' and v.split = 'validation' and experiment = 'intervals' and term = 'kl'

-- agree: all runs, with the experiment they share a spec with
select a.experiment, a.run, b.experiment as other from runs a left join runs b on a.spec_hash = b.spec_hash and a.experiment < b.experiment

-- agree: the nearest size above
select a.latent, min(b.latent) as next from (select distinct latent from runs) a left join (select distinct latent from runs) b on b.latent > a.latent group by a.latent order by a.latent

-- agree: inequality within a range
select count(*) as n from runs a join runs b on a.experiment = b.experiment and a.prediction_seconds > b.prediction_seconds * 2 where a.experiment = 'recommended'

-- agree: classes from a table of bounds
with bounds as (select 0 as low, 60 as high, 'short' as name union all select 60, 300, 'medium' union all select 300, 1000000, 'long') select b.name, count(*) as n from runs r join bounds b on r.prediction_seconds >= b.low and r.prediction_seconds < b.high group by b.name

-- agree: names for values from a table of names
with names as (select 'empty' as scenario, 'Empty' as name union all select 'cluttered', 'Cluttered') select n.name, r.latent, count(*) as runs from runs r join names n on n.scenario = r.scenario group by n.name, r.latent

-- agree: a right join with what has no runs
with wanted as (select 4 as latent union all select 5 union all select 16) select w.latent, count(r.run) as n from runs r right join wanted w on w.latent = r.latent group by w.latent order by w.latent

-- agree: a full join of two experiments by the scenario and size
select coalesce(a.scenario, b.scenario) as scenario, coalesce(a.latent, b.latent) as latent, a.n as single, b.n as multi from (select scenario, latent, count(*) as n from runs where experiment = 'which_sense' group by scenario, latent) a full join (select scenario, latent, count(*) as n from runs where experiment = 'choose_recommended' and variant like 'change=episodes_%' group by scenario, latent) b on a.scenario = b.scenario and a.latent = b.latent

-- agree: settings of one experiment that another lacks
select distinct latent from runs where experiment = 'reproduction' except select latent from runs where experiment = 'recommended' order by latent

-- agree: the union of two selections without repetitions
select experiment, run from runs where latent = 4 union select experiment, run from runs where seed = 0 order by experiment, run limit 30

-- agree: the union of selections with their names
select 'fast' as kind, count(*) as n from runs where prediction_seconds < 60 union all select 'slow', count(*) from runs where prediction_seconds >= 60 union all select null, count(*) from runs where prediction_seconds is null

-- agree: a union within with, in groups
with t as (select experiment, 'prediction' as task, prediction_seconds as seconds from runs union all select experiment, 'reconstruction', reconstruction_seconds from runs) select experiment, task, sum(seconds) as seconds, count(seconds) as n from t group by experiment, task

-- agree: totals below the groups
select experiment, count(*) as n from runs group by experiment union all select 'all', count(*) from runs order by n desc, experiment

-- agree: subtotals by union
with c as (select scenario, latent, count(*) as n from runs group by scenario, latent) select scenario, latent, n from c union all select scenario, null, sum(n) from c group by scenario union all select null, null, sum(n) from c

-- agree: the most frequent setting of each experiment
select experiment, latent, n from (select experiment, latent, count(*) as n, row_number() over (partition by experiment order by count(*) desc, latent) as place from runs group by experiment, latent) as c where place = 1

-- agree: which experiments have a scenario
select experiment, max(case when scenario = 'empty' then 'x' else '' end) as empty, max(case when scenario = 'cluttered' then 'x' else '' end) as cluttered from runs group by experiment order by experiment

-- agree: exists with a condition of its own
select distinct experiment from runs where exists (select 1 from runs where status = 'failed') or latent > 16

-- agree: the values of a list that no run has
select v from (select 4 as v union all select 8 union all select 16 union all select 32 union all select 64) as t where v not in (select latent from runs) order by v

-- agree: consecutive numbers from row numbers
select n from (select row_number() over (order by run, experiment) as n from runs) as t where n <= 5 order by n

-- agree: gaps between starts in minutes of a day
with t as (select experiment, run, cast(substr(started, 12, 2) as integer) * 3600 + cast(substr(started, 15, 2) as integer) * 60 + cast(substr(started, 18, 2) as integer) as s from runs where substr(started, 1, 10) = '2026-11-22') select experiment, run, s - lag(s) over (order by s, experiment, run) as gap from t

-- agree: starts in quarters of an hour
select left(started, 13) as hour, floor(cast(substr(started, 15, 2) as integer) / 15) as quarter, count(*) as n from runs group by 1, 2

-- agree: day and night
select case when cast(substr(started, 12, 2) as integer) between 6 and 17 then 'day' else 'night' end as part, count(*) as n from runs group by part

-- agree: the first and the last start of each day
select left(started, 10) as day, min(substr(started, 12, 8)) as first, max(substr(started, 12, 8)) as last from runs group by left(started, 10)

-- agree: runs that started in the second that another did
select started, count(*) as n from runs group by started having count(*) > 1

-- agree: a comparison of times as text
select count(*) filter (where started > '2026-11-22') as later, count(*) filter (where started < '2026-11-22T00:00:00Z') as earlier from runs

-- agree: aliases in quotes, with spaces and capitals
select "experiment" as "The Experiment", count(*) as "Number of runs" from "runs" group by "experiment" order by "Number of runs" desc, "The Experiment"

-- agree: keywords in capitals, and names in any case
SELECT R.Experiment, COUNT(*) AS N FROM RUNS AS R WHERE R.Latent IN (4, 16) AND R.Scenario LIKE 'e%' GROUP BY R.EXPERIMENT HAVING COUNT(*) >= 1 ORDER BY N DESC, 1 LIMIT 4

-- agree: several lines and comments
select experiment, -- the name
       count(*) as n /* all
       of them */
from runs
where true -- no condition
group by experiment

-- agree: a comma after the last column
select experiment, latent, from runs where experiment = 'intervals'

-- agree: no as before names
select experiment e, count(*) n from runs r where r.latent > 4 group by experiment

-- agree: the same column twice with other names
select latent as a, latent as b, latent + 0 as c from runs where experiment = 'intervals'

-- agree: names of select are not seen in where
select latent * 2 as seed, count(*) as n from runs where seed = 0 group by latent

-- agree: a name of select before it is used in group by and order by
select concat(scenario, ' z', latent) as cell, count(*) as n from runs group by cell order by cell

-- agree: brackets around everything
select (((latent))) as a, ((count(*))) as n from (runs) where ((latent > 4) and (((seed)) = 0)) group by (latent)

-- agree: powers, roots and constants
select distinct latent, sqrt(latent) as a, power(latent, 2) as b, ln(latent) / ln(2) as c, log2(latent) as d, exp(-latent / 10.0::double) as e from runs

-- agree: angles in degrees
select index, degrees(avg(abs(reference - predicted))) as error from predictions where modality = 'proprioception' and task = 'prediction' group by index

-- agree: errors in millinewtons as integers
select index, cast(round(1000 * avg(abs(reference - predicted))) as bigint) as mn from predictions where modality = 'contact_force' and task = 'prediction' and run like 'empty%' group by index

-- agree: rounding of negative numbers
select distinct index, floor(-1.5 * index) as a, ceil(-1.5 * index) as b, trunc(-1.5 * index) as c, round(-1.25::double * index, 1) as d from metrics where index < 6

-- agree: greatest and least of columns
select experiment, run, greatest(prediction_seconds, reconstruction_seconds, evaluation_seconds) as most, least(prediction_seconds, reconstruction_seconds, evaluation_seconds) as least from runs

-- agree: a logarithmic mean of times
select scenario, exp(avg(ln(prediction_seconds))) as typical, median(prediction_seconds) as middle, avg(prediction_seconds) as mean from runs where prediction_seconds > 0 group by scenario

-- agree: sums over pairs of index and direction
select modality, coalesce(direction, '-') as direction, count(distinct index) as elements, sum(value) as s from metrics where metric = 'mae' group by modality, coalesce(direction, '-')

-- agree: variances within and between groups
with g as (select experiment, avg(value) as mean, variance(value) as within, count(value) as n from metrics where metric = 'mae' and modality = 'contact_force' and model = 'network' and task = 'prediction' and index is null and direction is null group by experiment) select sum(n * within) / sum(n) as within, variance(mean) as between_ from g

-- agree: the slope of a straight line
select (count(*) * sum(x * y) - sum(x) * sum(y)) / (count(*) * sum(x * x) - sum(x) * sum(x)) as slope from (select log2(latent) as x, value as y from metrics where experiment = 'reproduction' and metric = 'r2' and model = 'network' and modality = 'contact_force' and task = 'prediction' and index is null and direction is null) as p

-- agree: the rank of each seed
select seed, avg(place) as mean from (select seed, rank() over (partition by scenario, latent order by value) as place from metrics where experiment = 'which_sense' and metric = 'mae' and model = 'network' and modality = 'contact_force' and task = 'prediction' and index is null and direction is null) as r group by seed

-- agree: how many wins each model has
with m as (select experiment, run, model, value, rank() over (partition by experiment, run order by value) as place from metrics where metric = 'mae' and task = 'prediction' and modality = 'contact_force' and index is null and direction is null) select model, sum(case when place = 1 then 1 else 0 end) as wins, count(*) as n from m group by model

-- agree: the model that is best for each link
select index, model, count(*) as n from (select experiment, run, index, model, row_number() over (partition by experiment, run, index order by value, model) as place from metrics where metric = 'mae' and task = 'prediction' and modality = 'contact_force' and index is not null) as b where place = 1 group by index, model order by index, model

-- agree: runs whose network is worse than ridge on any link
select distinct n.experiment, n.run from metrics n join metrics r on r.experiment = n.experiment and r.run = n.run and r.task = n.task and r.modality = n.modality and r.metric = n.metric and r.index = n.index where n.model = 'network' and r.model = 'ridge' and n.metric = 'mae' and n.value > r.value and n.task = 'prediction'

-- agree: comparison of tasks
select modality, metric, avg(value) filter (where task = 'prediction') - avg(value) filter (where task = 'reconstruction') as difference from metrics where model = 'network' and index is null and direction is null group by modality, metric

-- agree: experiments by whether they reconstruct
select reconstruction_seconds is not null as reconstructs, count(*) as n, count(distinct experiment) as experiments from runs group by reconstruction_seconds is not null

-- agree: aggregates of an empty selection
select count(*) as n, sum(value) as s, avg(value) as a, max(epoch) as e, min(run) as r, bool_or(value > 0) as b, stddev(value) as d from epochs where experiment = 'nothing'

-- agree: groups of an empty selection
select run, avg(value) as a from epochs where experiment = 'nothing' group by run having count(*) > 0 order by run

-- agree: windows of an empty selection
select run, row_number() over (order by run) as n, sum(latent) over () as s from runs where experiment = 'nothing'

-- agree: joins with an empty selection
select count(*) as n, count(b.run) as b from runs a left join (select * from runs where false) b on a.run = b.run

-- agree: limits of an empty selection
select run from runs where latent < 0 order by run limit 3 offset 1

-- agree: a constant selected for each group
select 'group' as kind, 1 as one, latent, count(*) as n from runs group by latent

-- agree: conditions on conditions that are null
select count(*) as n from runs where (reading = 'recommended') is not true and (role = 'single_to_multi') is distinct from true

-- agree: nulls in arithmetic, text and comparison
select count(*) as n, count(reconstruction_seconds + prediction_seconds) as a, count(reading || '!') as b, count(reading = role) as c, count(concat(reading, role)) as d, count(greatest(reconstruction_seconds, 0)) as e from runs

-- agree: coalesce of several columns
select coalesce(reading, role, nullif(variant, ''), experiment) as name, count(*) as n from runs group by 1

-- agree: moving means of five epochs
select experiment, run, epoch, avg(value) over (partition by experiment, run order by epoch rows between 4 preceding and current row) as mean from epochs where task = 'prediction' and split = 'validation' and term = 'total' and experiment like 'choose%'

-- agree: centered means, and rows without neighbors
select experiment, run, epoch, avg(value) over (partition by experiment, run order by epoch rows between 1 preceding and 1 following) as a, min(value) over (partition by experiment, run order by epoch rows between 2 preceding and 1 preceding) as b, max(value) over (partition by experiment, run order by epoch rows between 1 following and 3 following) as c, count(*) over (partition by experiment, run order by epoch rows between 3 preceding and 1 preceding) as d from epochs where task = 'prediction' and split = 'train' and term = 'total' and experiment = 'intervals'

-- agree: moving sums of integers, with nulls
select metric, index, sum(index) over (partition by metric order by index rows between 2 preceding and current row) as a, count(index) over (partition by metric order by index rows 1 preceding) as b, min(index) over (partition by metric order by index rows between current row and 1 following) as c from (select distinct metric, index from metrics) as m

-- agree: moving medians, quantiles and deviations
select experiment, run, epoch, median(value) over (partition by experiment, run order by epoch rows between 2 preceding and 2 following) as a, stddev(value) over (partition by experiment, run order by epoch rows between 3 preceding and current row) as b, quantile_cont(value, 0.25) over (partition by experiment, run order by epoch rows between 4 preceding and current row) as c, variance(value) over (partition by experiment, run order by epoch rows between 1 preceding and current row) as d from epochs where task = 'prediction' and split = 'train' and term = 'total' and experiment = 'choose_recommended' and variant like 'change=episodes_%'

-- agree: the mean of the rest of the partition
select run, epoch, avg(value) over (partition by experiment, run order by epoch rows between current row and unbounded following) as rest from epochs where experiment = 'intervals' and task = 'prediction' and split = 'train' and term = 'total'

-- agree: running medians and deviations
select experiment, run, epoch, median(value) over (partition by experiment, run order by epoch) as a, stddev(value) over (partition by experiment, run order by epoch) as b, variance(value) over (partition by experiment, run order by epoch rows unbounded preceding) as c from epochs where task = 'prediction' and split = 'validation' and term = 'total' and experiment = 'recommended'

-- agree: a running median goes to the last equal row
select run, latent, median(prediction_seconds) over (partition by scenario order by latent) as a from runs

-- agree: moving aggregates with NaN
select n, max(x) over (order by n rows between 1 preceding and current row) as a, min(x) over (order by n rows between 1 preceding and current row) as b from (select 1 as n, 1.5::double as x union all select 2, 0 / 0 union all select 3, 2.5 union all select 4, null union all select 5, null) as t

-- agree: a moving aggregate with a filter
select experiment, run, epoch, avg(value) filter (where epoch > 2) over (partition by experiment, run order by epoch rows between 2 preceding and current row) as mean from epochs where experiment = 'intervals' and task = 'prediction' and split = 'train' and term = 'total'

-- agree: a named window
select run, latent, sum(latent) over w as a, rank() over w as b, count(*) over () as c from runs window w as (partition by scenario order by latent)

-- agree: two named windows, in qualify and in order by
select experiment, run, row_number() over best as place from runs window best as (partition by experiment order by prediction_seconds, run), all_runs as (order by experiment) qualify row_number() over best <= 2 and rank() over all_runs < 200 order by experiment, place

-- agree: the first row of each key
select distinct on (experiment, run) experiment, run, epoch, value from epochs where task = 'prediction' and split = 'validation' and term = 'total' order by experiment, run, value, epoch

-- agree: the first row of each key, which is not selected
select distinct on (scenario) experiment, run from runs order by scenario, started desc, experiment, run

-- agree: the first row of each key by name and by number
select distinct on (s, 2) scenario as s, latent, run from runs order by scenario, latent, run, experiment limit 4

-- agree: the first group of each key
select distinct on (scenario) scenario, latent, count(*) as n from runs group by scenario, latent order by scenario, count(*) desc, latent

-- agree: counts of conditions
select experiment, count_if(scenario = 'empty') as empty, count_if(reconstruction_seconds > 10) as slow, count_if(null) as none from runs group by experiment

-- agree: an alias of fewer columns than there are
select a, scenario, count(*) as n from runs as r(a) group by a, scenario

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

-- refuse: a rank without an order | rank needs an order: OVER (ORDER BY …)
select rank() over (partition by scenario) from runs

-- refuse: row_number without a window | row_number needs OVER (ORDER BY …)
select row_number() from runs

-- refuse: a misspelled table | there is no table 'metric'; did you mean 'metrics'? There are runs, epochs
select * from metric

-- refuse: an unknown table | there is no table 'nope'; there are runs, epochs, metrics, all_metrics, sums, predictions, all_predictions, forces, frames, episodes
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

-- refuse: a number rounded to decimals, cast to an integer | 'round(value, 1)' is a real number; choose how to round it: cast(round(…) as integer), or floor, ceil or trunc
select cast(round(value, 1) as integer) from metrics

-- refuse: a constant cast to an integer | '2.5' is a real number; choose how to round it
select cast(2.5 as integer)

-- refuse: a remainder by zero in a column | 5 % 0 has no value, because the divisor is 0; leave out such rows, or write nullif(…, 0)
select 5 % seed from runs

-- refuse: a remainder by zero that case does not exclude | 5 % 0 has no value
select case when seed >= 0 then 5 % seed end from runs

-- refuse: a remainder by zero in a condition of case | 5 % 0 has no value
select case when 5 % seed = 1 then 1 else 0 end from runs

-- refuse: a remainder by zero beside a condition that is no where | 5 % 0 has no value
select seed > 0 and 5 % seed = 1 from runs

-- refuse: a remainder by zero in rows that filter excludes | 5 % 0 has no value
select sum(5 % seed) filter (where seed > 0) from runs

-- refuse: text that is no integer, which case does not exclude | is not an integer from -2147483648 to 2147483647; TRY_CAST returns null instead
select case when latent > 1 then cast(run as integer) end from runs

-- refuse: text that is no integer in a condition | ' is not an integer
select count(*) from runs where cast(variant as integer) > 3

-- refuse: a decimal that is too large for an integer | '9999999999.5' is not an integer from -2147483648 to 2147483647
select cast('9999999999.5' as integer)

-- refuse: a name of select with an aggregate in where | 'avg(value)' can't be in WHERE; use HAVING
select avg(value) as a from metrics where a > 1

-- refuse: a window that is not defined | there is no window 'v'; define it with WINDOW v AS (…)
select sum(latent) over v from runs window w as (order by seed)

-- refuse: a window that adds to another | a window can't add to the window w; write OVER w, or all of its parts
select sum(latent) over (w order by seed) from runs window w as (partition by scenario)

-- refuse: a running deviation of all rows | rows takes too long; use PARTITION BY, or fewer rows
select stddev(value) over (order by epoch) from epochs

-- refuse: a frame that ends before it begins | the frame 'ROWS BETWEEN 1 FOLLOWING AND 1 PRECEDING' ends before it begins
select avg(value) over (order by epoch rows between 1 following and 1 preceding) from epochs

-- refuse: a frame of a range of values | the frame 'RANGE BETWEEN 2 PRECEDING AND CURRENT ROW' is not supported
select sum(value) over (order by epoch range between 2 preceding and current row) from epochs

-- refuse: a frame without an order | the frame 'ROWS BETWEEN 2 PRECEDING AND CURRENT ROW' is not supported; use ORDER BY with ROWS
select sum(value) over (rows between 2 preceding and current row) from epochs

-- refuse: a frame of a computed number of rows | a frame takes a whole number of rows, not '1 + 1'
select sum(value) over (order by epoch rows between 1 + 1 preceding and current row) from epochs

-- refuse: the first value of a moving frame | the first or last value of a frame with a number of rows is not supported; use lag or lead
select first_value(value) over (order by epoch rows between 2 preceding and current row) from epochs

-- refuse: a moving maximum of text | a moving max of text is not supported
select max(run) over (order by started rows between 2 preceding and current row) from runs

-- refuse: distinct aggregates over windows | DISTINCT is not supported with OVER
select count(distinct latent) over () from runs

-- refuse: other functions over windows | ntile can't have OVER; only aggregates and row_number, rank
select ntile(4) over (order by latent) from runs

-- refuse: distinct, ordered by an expression of a column | with DISTINCT, ORDER BY can only use columns of SELECT; add 'length(experiment)' to SELECT
select distinct experiment from runs order by length(experiment)

-- refuse: a cube | combine several queries with UNION ALL
select scenario, latent, count(*) from runs group by cube (scenario, latent)

-- refuse: groups with rollup | combine several queries with UNION ALL
select metric, avg(value) from metrics group by metric with rollup

-- refuse: a time as a timestamp | 'started' is text such as 2026-01-31T12:00:00Z
select started::timestamp from runs

-- refuse: a time as a date | 'started' is text such as 2026-01-31T12:00:00Z
select cast(started as date) from runs

-- refuse: functions of dates | 'date_trunc' is about dates, and no table has any
select date_trunc('day', started) from runs

-- refuse: formatted dates | 'strftime' is about dates, and no table has any
select strftime(started, '%Y-%m') from runs

-- refuse: intervals | is about dates, and no table has any
select started - interval '1 day' from runs

-- refuse: the name of a function in a query with groups | there is no function 'var_pop'; write stddev or variance, which are those of a sample
select metric, var_pop(value) as a from metrics group by metric

-- refuse: a logarithm without a base | there is no function 'log'; write log10, or ln for the natural logarithm
select log(parameters) from runs

-- refuse: a cube root | there is no function 'cbrt'; write power(x, 1.0 / 3)
select cbrt(parameters) from runs

-- refuse: other functions of angles | there is no function 'atan'; write sin, cos and atan2
select atan(value) from metrics

-- refuse: pi | there is no function 'pi'; write radians(180)
select pi() from runs

-- refuse: a sign | there is no function 'sign'; write CASE WHEN x > 0 THEN 1 WHEN x < 0 THEN -1 ELSE 0 END
select sign(value) from metrics

-- refuse: a longer name of ceil | there is no function 'ceiling'; write ceil
select ceiling(value) from metrics

-- refuse: another name of coalesce | there is no function 'ifnull'; write coalesce
select ifnull(index, 0) from metrics

-- refuse: another name of length | there is no function 'char_length'; write length
select char_length(run) from runs

-- refuse: a longer name of substr | there is no function 'substring'; write substr(text, first, count)
select substring(run from 1 for 5) from runs

-- refuse: spaces at both ends | there is no function 'trim'; write replace(text, ' ', '')
select trim(both ' ' from run) from runs

-- refuse: spaces at one end | there is no function 'ltrim'; write replace(text, ' ', '')
select ltrim(run) from runs

-- refuse: another name of avg | there is no function 'mean'; write avg
select mean(value) from metrics

-- refuse: the deviation of a population | there is no function 'stddev_pop'; write stddev or variance, which are those of
select stddev_pop(value) from metrics

-- refuse: lists of texts | there is no function 'string_agg'
select string_agg(run, ',') from runs

-- refuse: functions of regular expressions | there is no function 'regexp_matches'
select regexp_matches(run, 'z[0-9]+') from runs

-- refuse: operators of regular expressions | the operator ~ is not supported
select run ~ 'z[0-9]+' from runs

-- refuse: ordered sets | a function takes only arguments, DISTINCT, FILTER and OVER
select percentile_cont(0.5) within group (order by value) from metrics

-- refuse: several quantiles at once | '[0.1, 0.9]' is not supported
select quantile_cont(value, [0.1, 0.9]) from metrics

-- refuse: an aggregate of two columns | there is no function 'corr'
select corr(reference, predicted) from predictions

-- refuse: all columns but one | * with EXCLUDE, REPLACE or RENAME is not supported; name the columns
select * exclude (command) from runs

-- refuse: pivot | Expected: an SQL statement, found: pivot
pivot metrics on metric using avg(value)

-- refuse: functions that return tables | 'range' is not a table
select x from range(5) t(x)

-- refuse: a join that only filters | use JOIN, LEFT JOIN, RIGHT JOIN, FULL JOIN or CROSS JOIN
select * from runs semi join epochs using (run)

-- refuse: subqueries of each row | LATERAL is not supported; use a join
select r.run from runs r, lateral (select 1) l

-- refuse: text and numbers in a list | mixes text with an integer
select * from runs where run in ('a', 2)

-- refuse: a year as a number | 'started > 2026' mixes text with an integer
select run from runs where started > 2026

-- refuse: rounding to tens | round takes a number, and a number of decimals from 0 to 15
select round(parameters, -3) from runs

-- refuse: powers by an operator | the operator ^ is not supported
select latent ^ 2 from runs

-- refuse: a column grouped by its number alone | 'value' must be in GROUP BY
select metric, value from metrics group by 1

-- refuse: too many names of columns | 'r' names 3 columns, but there are 2
select * from (select 1 as a, 2 as b) as r(x, y, z)

-- refuse: distinct pairs | count takes 1 value(s), not 2
select count(distinct experiment, run) from runs

-- refuse: a count of numbers | count_if takes a condition, not an integer
select count_if(latent) from runs

-- refuse: numbers in text | a real number can't be cast to text
select concat(metric, value) from metrics

-- refuse: decimals | the type DECIMAL(10,2) is not supported; use INTEGER, BIGINT, DOUBLE, VARCHAR or BOOLEAN
select cast(latent as decimal(10, 2)) from runs

-- refuse: the greatest of texts | greatest takes a number, not text
select greatest(scenario, 'a') from runs

-- refuse: sums of conditions | sum takes a number, not true or false
select sum(git_dirty) from runs

-- refuse: two queries | it has 2 statements instead of one
select 1; select 2
